// What widgets lack for the keyboard: a way past the drawer, lists that open, items that say which is chosen, tips where the focus is.

export function render({model, el}) {
  const skip = skipLink(() => el.getRootNode().host.nextElementSibling)
  model.on("remove", () => skip.remove())
  // A focus that moves within one shadow root is not heard of out here: so every key is followed.
  let last = null, mark = null
  const tell = (at, isEnded) => {
    if (at === last && !isEnded) return
    const point = (type) => mark?.dispatchEvent(new MouseEvent(type, {bubbles: true}))
    point("mouseout")
    mark = at && at !== last ? at.getRootNode().querySelector(MARK) : null
    point("mouseover")
    last = at
  }
  listen(model, {
    click: (event) => markItems(event.composedPath()[0]),
    pointerdown: () => tell(null),
    keyup: (event) => {
      openList(event)
      name(focused())  // at once: the focus has moved by then
    },
    keydown: (event) => {
      openList(event)
      setTimeout(() => {
        name(focused())
        tell(focused(), event.key === "Escape")
      })
    },
  }, {capture: true})
}

// The mark beside a field's name, whose tip is told where the focus is.
const MARK = "label > svg.MuiSvgIcon-root, .MuiFormControlLabel-label > svg.MuiSvgIcon-root"

// A plot that has the focus has no name, and a fieldset repeats that of the group within.
function name(at) {
  at.closest("fieldset.MuiFormControl-root")?.setAttribute("role", "presentation")
  if (!at.matches(".bk-events")) return
  at.style.outline = "2px solid #2b8ab3"  // it has none to show that it has the focus
  at.addEventListener("blur", () => { at.style.outline = "" }, {once: true})
  at.setAttribute("role", "group")
  at.setAttribute("aria-label", at.getRootNode().host.getRootNode().host.getAttribute("aria-label"))
}

// The first stop, seen while it has the focus.
function skipLink(results) {
  const room = Object.assign(document.createElement("nav"), {ariaLabel: "Skip", innerHTML: `<style>
    .skip { position: fixed; left: 8px; top: 8px; z-index: 10000; padding: 10px 14px; background: #fff; color: #0b4f6c; outline: 3px solid }
    .skip:not(:focus) { top: -60px }</style><button type="button" class="skip">Skip to figures</button>`})
  room.lastElementChild.onclick = () => {
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

// A list of panel-material-ui 0.16 opens by click alone. The space bar opens it when it comes up, or it would choose the first item.
function openList(event) {
  const box = event.composedPath()[0]
  if (!["Enter", " ", "ArrowDown", "ArrowUp"].includes(event.key) || !box.matches?.(LIST)) return
  if (box.getAttribute("aria-expanded") === "true" || box.getAttribute("aria-disabled") === "true") return
  event.preventDefault()
  if ((event.key === " ") === (event.type === "keyup")) box.click()
}

// Nor do its items say which one is chosen; that one has the focus first.
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
