// The history: a sheet at the right edge with every result of the session.

export function render({model, el}) {
  el.innerHTML = `<div class="sheet" popover="manual" role="dialog" aria-label="History"></div>`
  const sheet = el.firstElementChild
  tellActions(sheet, model)
  sheet.addEventListener("keydown", ({key, target}) => {
    const isName = target.matches(".name")
    if (key === "Enter" && isName) target.blur()
    if (key === "Escape" && isName) target.value = target.getAttribute("value")
    else if (key === "Escape") model.send_msg({action: "close"})
  })

  let before = null // what had the focus
  const follow = () => {
    setMarkup(sheet, model.html)
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
  model.on(["open", "html"], follow)
  requestAnimationFrame(() => { if (sheet.isConnected) follow() })
}
