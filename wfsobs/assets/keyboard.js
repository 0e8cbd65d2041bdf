// What the keyboard needs beyond what the widgets do themselves: a way past the drawer, lists that open, items that say which of
// them is chosen, tips where the focus is.

export function render({model, el}) {
  el.innerHTML = `<div class="tip" role="tooltip" popover="manual"></div>`
  const stop = new AbortController()
  const on = (type, heard) => document.addEventListener(type, heard, {signal: stop.signal, capture: true})
  const skip = skipLink(() => el.getRootNode().host.nextElementSibling)
  model.on("remove", () => { stop.abort(); skip.remove() })
  const tips = tipsAt(el.firstElementChild)
  for (const type of ["keydown", "keyup"]) on(type, openList)
  on("click", (event) => markItems(event.composedPath()[0]))
  // What moves the focus within one shadow root is not heard of out here: so every key is followed.
  let last = null
  on("pointerdown", tips.hide)
  on("keyup", () => name(focused()))  // at once: the focus has moved by then
  on("keydown", (event) => setTimeout(() => {
    const at = focused()
    name(at)
    if (at !== last || event.key === "Escape") tips.hide()
    if (at !== last) tips.show(at)
    last = at
  }))
}

// Names for what Bokeh and panel-material-ui leave without: a plot that has the focus, and a fieldset whose group within has one.
function name(at) {
  at.closest("fieldset.MuiFormControl-root")?.setAttribute("role", "presentation")
  if (!at.matches(".bk-events")) return
  at.style.outline = "2px solid #2b8ab3"  // it has none to show that it has the focus
  at.addEventListener("blur", () => { at.style.outline = "" }, {once: true})
  at.setAttribute("role", "group")
  at.setAttribute("aria-label", at.getRootNode().host.getRootNode().host.getAttribute("aria-label"))
}

// The first stop of the page, seen while it has the focus.
function skipLink(results) {
  const room = Object.assign(document.createElement("nav"), {ariaLabel: "Skip", innerHTML: `<button type="button">Skip to figures</button>`})
  const link = room.firstElementChild
  link.style = "position: fixed; left: 8px; z-index: 10000; padding: 10px 14px; border: 0; border-radius: 4px; background: #fff; " +
    "color: #0b4f6c; font: 14px sans-serif; outline: 3px solid #0b4f6c"
  const put = (top) => { link.style.top = top }
  put("-60px")
  link.onfocus = () => put("8px")
  link.onblur = () => put("-60px")
  link.onclick = () => {
    const to = results()
    to.tabIndex = -1
    to.style.outline = "none"
    to.focus()
    to.scrollIntoView()
  }
  document.body.prepend(room)
  return room
}

const LIST = "[role=combobox][aria-haspopup=listbox]"

// A list of panel-material-ui 0.16 opens by click alone: what opens it by keyboard calls a function that it has not been given.
// The space bar opens it when it comes up, or it would choose the first item by that.
function openList(event) {
  const box = event.composedPath()[0]
  if (!["Enter", " ", "ArrowDown", "ArrowUp"].includes(event.key) || !box.matches?.(LIST)) return
  if (box.getAttribute("aria-expanded") === "true" || box.getAttribute("aria-disabled") === "true") return
  event.preventDefault()
  if ((event.key === " ") === (event.type === "keyup")) box.click()
}

// Nor do its items say that they are those of a list, and which one is chosen; that one has the focus first.
function markItems(at, tries = 600) {
  const box = at.closest?.(LIST)
  if (!box || !tries) return
  const isOpen = box.getAttribute("aria-expanded") === "true"  // else the list may be one that is fading
  const items = isOpen ? [...box.getRootNode().querySelectorAll("ul[role=listbox] > li")] : []
  for (const item of items) {
    const isChosen = item.textContent === box.textContent
    Object.assign(item, {role: "option", ariaSelected: isChosen})
    if (isChosen) item.focus()
  }
  const isThere = items.includes(box.getRootNode().activeElement)
  if (!isThere) requestAnimationFrame(() => markItems(box, tries - 1))  // the list is on its way
}

const MARK = "label > svg.MuiSvgIcon-root, .MuiFormControlLabel-label > svg.MuiSvgIcon-root"

// The tip of whatever has the focus: that of the mark beside a field's name, or its title.
function tipsAt(own) {
  let mark = null
  const point = (type) => mark?.dispatchEvent(new MouseEvent(type, {bubbles: true}))
  const hide = () => {
    point("mouseout")
    mark = null
    own.hidePopover()
  }
  const show = (at) => {
    mark = at.getRootNode().querySelector?.(MARK) ?? null
    point("mouseover")
    if (mark || !at.title) return
    own.textContent = at.title
    own.showPopover()
    const box = at.getBoundingClientRect()
    own.style.top = `${Math.min(box.bottom + 4, innerHeight - own.offsetHeight - 4)}px`
    own.style.left = `${Math.min(box.left, innerWidth - own.offsetWidth - 8)}px`
  }
  return {hide, show}
}
