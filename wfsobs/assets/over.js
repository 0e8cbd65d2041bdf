// One button for all settings: it stands beside the setting in the drawer that is pointed at or has the focus, and asks for
// the error over it.

const TAG = "setting:"

// The setting of an event: that of the component it went through, and in a table that of the cell.
function settingAt(event) {
  const path = event.composedPath()
  if (!path.some((it) => it.matches?.(".sidebar, .MuiDrawer-root"))) return null
  for (const view of Bokeh.index.query((it) => it.model.tags?.some((tag) => tag.startsWith?.(TAG)))) {
    if (!path.includes(view.el)) continue
    const name = view.model.tags.find((tag) => tag.startsWith?.(TAG)).slice(TAG.length)
    const cell = path.find((it) => it.dataset?.cell)
    if (cell) return {name: `${name}.${cell.dataset.cell}`, box: cell}
    return name.includes(".") && !view.el.shadowRoot?.querySelector(".peaks") ? {name, box: view.el} : null
  }
  return null
}

function offerSweep(model, el) {
  const button = document.createElement("button")
  Object.assign(button, {type: "button", className: "over", textContent: "error over this", hidden: true, popover: "manual"})
  button.title = "Run the scenario over values of this setting"
  el.append(button)
  let over = ""
  const offer = (event) => {
    if (event.composedPath().includes(button)) return
    const found = settingAt(event)
    if (!found) return withdraw()
    over = found.name
    const box = found.box.getBoundingClientRect()
    button.hidden = false
    button.setAttribute("aria-label", `Error over ${over}`)
    button.style.top = `${box.top - 2}px`
    button.style.left = `${Math.max(box.right - button.offsetWidth, 0)}px`
    if (!button.matches(":popover-open")) button.showPopover()
  }
  const withdraw = () => {
    if (button.matches(":popover-open")) button.hidePopover()
    button.hidden = true
  }
  button.onclick = () => {
    withdraw()
    model.send_msg({over})
  }
  document.addEventListener("pointerover", offer)
  document.addEventListener("focusin", offer)
  document.addEventListener("scroll", withdraw, true)
  model.on("remove", () => {
    document.removeEventListener("pointerover", offer)
    document.removeEventListener("focusin", offer)
    document.removeEventListener("scroll", withdraw, true)
  })
}
