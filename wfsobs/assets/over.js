// One button for all settings: it stands beside the setting in the drawer that is pointed at or has the focus, and asks for
// the error over it. Alt+O does the same for the setting with the focus, without another stop of the tab key for each.

const TAG = "setting:"

// The setting of an event, and where it is drawn: that of the component it went through, and in a table that of the cell.
function settingAt(event) {
  const path = event.composedPath()
  const views = [...Bokeh.index.query((it) => it.model.tags?.some((tag) => tag.startsWith?.(TAG)))]
  const view = views.find((it) => path.includes(it.el))
  if (!view) return null
  const name = view.model.tags.find((tag) => tag.startsWith?.(TAG)).slice(TAG.length)
  const cell = path.find((it) => it.dataset?.cell)
  if (cell) return {name: `${name}.${cell.dataset.cell}`, box: cell}
  return name.includes(".") && !view.el.shadowRoot?.querySelector(".peaks") ? {name, box: view.el} : null
}

function offerSweep(model, el) {
  const button = Object.assign(document.createElement("button"), {
    type: "button", className: "over", textContent: "Sweep this setting", popover: "manual",
    title: "Run the scenario over values of this setting (Alt+O)", ariaKeyShortcuts: "Alt+O"})
  el.append(button)
  let found = null, at = null

  const place = () => {
    if (!button.isConnected) return // drawn anew, and not in the page yet or no longer
    const box = found?.box.getBoundingClientRect()
    const seen = box && box.height > 0 && box.top >= 0 && box.bottom <= window.innerHeight
    if (button.matches(":popover-open") !== Boolean(seen)) button.togglePopover(Boolean(seen))
    if (!seen) return
    button.style.top = `${box.top < button.offsetHeight ? box.bottom : box.top - button.offsetHeight}px` // not over what is changed
    button.style.left = `${Math.max(box.right - button.offsetWidth, 0)}px`
  }
  const offer = (event) => {
    const under = event.composedPath()[0]
    if (under === at || under === button) return
    at = under
    found = settingAt(event)
    if (found) button.setAttribute("aria-label", `Error over ${found.name}`)
    place()
  }
  const ask = () => {
    model.send_msg({over: found.name})
    found = null
    place()
  }
  const press = (event) => {
    if (!event.altKey || event.ctrlKey || event.metaKey || event.code !== "KeyO") return
    found = settingAt(event)
    if (!found) return
    event.preventDefault()
    ask()
  }
  button.onclick = ask
  // Not pointerover and focusin: between two parts of the page they do not leave its shadow tree.
  const stop = new AbortController()
  for (const [name, act] of Object.entries({pointermove: offer, keyup: offer, keydown: press, scroll: place})) {
    document.addEventListener(name, act, {capture: true, signal: stop.signal})
  }
  model.on("remove", () => stop.abort())
}
