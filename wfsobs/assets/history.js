// The history: a sheet at the right edge with every result of the session.

export function render({model, el}) {
  const sheet = document.createElement("div")
  Object.assign(sheet, {className: "sheet", popover: "manual"})
  sheet.setAttribute("role", "dialog")
  sheet.setAttribute("aria-label", "History")
  el.append(sheet)
  const file = () => sheet.querySelector("[type=file]")
  tellActions(sheet, model)
  sheet.addEventListener("click", (event) => { if (event.target.matches(".pick")) file().click() })
  sheet.addEventListener("change", ({target}) => {
    if (target !== file() || !target.files[0]) return
    send(model, target.files[0])
    target.value = ""
  })
  sheet.addEventListener("keydown", ({key, target}) => {
    const isName = target.matches(".name")
    if (key === "Enter" && isName) target.blur()
    if (key === "Escape" && isName) target.value = target.getAttribute("value")
    else if (key === "Escape") model.send_msg({action: "close"})
  })

  let before = null // what had the focus
  const follow = () => {
    setMarkup(sheet, model.html)
    sheet.classList.toggle("dark", model.dark)
    const close = sheet.querySelector("button") // of a sheet that is opened again it may come after the word to open
    const isOpen = model.open && close !== null
    if (isOpen === sheet.matches(":popover-open")) return
    if (isOpen) {
      before = focused()
      sheet.showPopover()
      close.focus()
    } else {
      sheet.hidePopover()
      before?.focus()
    }
  }
  for (const name of ["open", "html", "dark"]) model.on(name, follow)
  model.on("msg:custom", (event) => {
    const {name, kind, content} = event.data ?? event
    save(name, kind, content)
  })
  requestAnimationFrame(() => { if (sheet.isConnected) follow() })
}

function focused() {
  let it = document.activeElement
  while (it?.shadowRoot?.activeElement) it = it.shadowRoot.activeElement
  return it
}
