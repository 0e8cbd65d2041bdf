// The help at the top right: shortcuts and words, by button or by the key "?", and a tour of the page.

const STOPS = [ // where, what is said of it
  [["[role=combobox][aria-haspopup=listbox]", "[aria-label='Open drawer']"],
   "Start from a preset, or change a setting: when a slider is released the comparison runs again. The list and the search have every setting."],
  [["p.verdict"], "The result in words: which observer has the smallest error, how far it is from the smallest possible error, and which ones do harm."],
  [[".strip"], "The observers that the verdict names, with their RMS errors and what these are made of. Click a row to hide or show its line, double-click it to see the line alone."],
  [["[role=figure]"], "The error over time and its spectrum. Drag over a stretch to zoom; the switches above show signals, other modes and units."],
  [["[aria-label='Share']"], "The address of the page has what you have changed: share it, save data and figures, or make a report of everything."],
]

export function render({model, el}) {
  const make = (name, parent, properties = {}, attributes = {}) => {
    const it = Object.assign(document.createElement(name), properties)
    for (const [key, value] of Object.entries(attributes)) it.setAttribute(key, value)
    parent.append(it)
    return it
  }
  const open = make("button", el, {type: "button", className: "open", textContent: "?", title: "Shortcuts, words and a tour (?)"},
                    {"aria-label": "Help"})
  const sheet = make("div", el, {className: "sheet", popover: "auto"}, {role: "dialog", "aria-label": "Help"})
  open.popoverTargetElement = sheet
  const fill = () => {
    if (sheet.childElementCount) return
    const top = make("div", sheet, {className: "top"})
    const start = make("button", top, {type: "button", textContent: "Take the tour"})
    const close = make("button", top, {type: "button", textContent: "Close"})
    start.onclick = () => { sheet.hidePopover(); tour(el) }
    close.onclick = () => { sheet.hidePopover(); open.focus() }
    for (const [title, words] of [["Shortcuts", model.shortcuts], ["Words", model.terms]]) {
      make("h2", sheet, {textContent: title})
      const list = make("dl", sheet)
      for (const [word, meaning] of Object.entries(words)) {
        make("dt", list, {textContent: word})
        make("dd", list, {textContent: meaning})
      }
    }
  }
  sheet.addEventListener("beforetoggle", () => { fill(); paint(sheet) })
  sheet.addEventListener("toggle", (event) => { if (event.newState === "open") sheet.querySelector("button").focus() })

  if (isFirst()) setTimeout(() => offer(el), 2000)
  const stop = new AbortController()
  document.addEventListener("keydown", (event) => {
    const at = event.composedPath()[0]
    if (event.ctrlKey || event.metaKey || event.altKey || at.matches?.("input, textarea, select, [contenteditable]")) return
    if (event.key === "?") sheet.togglePopover()
    if (event.key === "/") {
      const box = deep("input[aria-label='Find a setting']")
      if (box?.getBoundingClientRect().width) { event.preventDefault(); box.focus() }
    }
  }, {signal: stop.signal})
  model.on("remove", () => stop.abort())
}

// The first element on the page, in whatever shadow, that matches and is seen.
function deep(selector, root = document) {
  for (const it of root.querySelectorAll("*")) {
    if (it.matches(selector) && it.getBoundingClientRect().width > 0) return it
    const below = it.shadowRoot && deep(selector, it.shadowRoot)
    if (below) return below
  }
  return null
}

// Whether nobody has been here with this browser, as far as it tells.
function isFirst() {
  try {
    return localStorage.getItem("wfsobs-tour") === null
  } catch {
    return false
  }
}

// Offer the tour, once: it goes with the next click beside it.
function offer(el) {
  if (!el.isConnected) return
  localStorage.setItem("wfsobs-tour", "offered")
  const note = Object.assign(document.createElement("div"), {className: "tour offer", popover: "auto"})
  note.setAttribute("role", "dialog")
  note.setAttribute("aria-label", "Tour offer")
  const button = (words, act) => Object.assign(document.createElement("button"), {type: "button", textContent: words, onclick: act})
  const close = Object.assign(button("×", () => note.hidePopover()), {ariaLabel: "Not now"})
  note.append(button("Take the tour", () => { note.hidePopover(); tour(el) }), close)
  note.ontoggle = (event) => { if (event.newState === "closed") note.remove() }
  el.append(note)
  note.showPopover()
  paint(note)
}

// Show the stops of the tour one by one, each with what it is about in a ring.
function tour(el) {
  const note = document.createElement("div")
  Object.assign(note, {className: "tour", popover: "manual"})
  note.setAttribute("role", "dialog")
  note.setAttribute("aria-label", "Tour")
  note.setAttribute("aria-live", "polite")
  const ring = document.createElement("div")
  Object.assign(ring, {className: "ring", popover: "manual"})
  el.append(ring, note)
  let at = 0
  const end = () => { note.remove(); ring.remove(); el.querySelector(".open")?.focus() }
  const place = (target) => {
    const box = target.getBoundingClientRect()
    Object.assign(ring.style, {left: `${box.left - 6}px`, top: `${box.top - 6}px`, width: `${box.width + 12}px`, height: `${box.height + 12}px`})
    const below = box.bottom + 12 + note.offsetHeight < window.innerHeight
    const room = window.innerWidth - note.offsetWidth - 8
    note.style.top = `${below ? box.bottom + 12 : Math.max(8, box.top - note.offsetHeight - 12)}px`
    note.style.left = `${Math.max(8, Math.min(box.left, room))}px`
  }
  const show = () => {
    const [selectors, text] = STOPS[at]
    const target = selectors.map((selector) => deep(selector)).find(Boolean)
    const line = Object.assign(document.createElement("p"), {textContent: text})
    const count = Object.assign(document.createElement("small"), {textContent: `${at + 1} of ${STOPS.length}`})
    const button = (words, act) => Object.assign(document.createElement("button"), {type: "button", textContent: words, onclick: act})
    const last = at === STOPS.length - 1
    const next = button(last ? "Done" : "Next", () => { if (last) end(); else { at += 1; show() } })
    const buttons = [...at > 0 ? [button("Back", () => { at -= 1; show() })] : [], ...last ? [] : [button("Skip", end)], next]
    note.replaceChildren(line, count, ...buttons)
    target?.scrollIntoView({block: "center"})
    if (!note.matches(":popover-open")) { ring.showPopover(); note.showPopover(); paint(note) }
    if (target) requestAnimationFrame(() => place(target))
    next.focus()
  }
  note.onkeydown = (event) => { if (event.key === "Escape") { event.stopPropagation(); end() } }
  show()
}
