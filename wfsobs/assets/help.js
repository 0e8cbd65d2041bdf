// The help at the top right: shortcuts and words, by button or by the key "?", and a tour of the page.

const TOLD = "wfsobs-tour"

export function render({model, el}) {
  el.innerHTML = model.html
  const [open, sheet, offer, ring, note] = [".open", "#help", ".offer", ".ring", ".stops"].map((it) => el.querySelector(it))
  const stops = [...note.querySelectorAll("p")], [back, skip, next] = note.querySelectorAll("button")
  let at = 0

  const end = () => { note.hidePopover(); ring.hidePopover(); open.focus() }
  const show = () => {
    stops.forEach((it, i) => { it.hidden = i !== at })
    note.querySelector("small").textContent = `${at + 1} of ${stops.length}`
    back.hidden = at === 0
    skip.hidden = at === stops.length - 1
    next.textContent = skip.hidden ? "Done" : "Next"
    ring.showPopover()
    note.showPopover()
    next.focus()
    const target = deep(stops[at].dataset.at)
    target?.scrollIntoView({block: "center"})
    if (target) requestAnimationFrame(() => place(target.getBoundingClientRect()))
  }
  const place = (box) => {
    ring.style.cssText = `left: ${box.left - 6}px; top: ${box.top - 6}px; width: ${box.width + 12}px; height: ${box.height + 12}px`
    const isBelow = box.bottom + 12 + note.offsetHeight < innerHeight
    note.style.top = `${isBelow ? box.bottom + 12 : Math.max(8, box.top - note.offsetHeight - 12)}px`
    note.style.left = `${Math.max(8, Math.min(box.left, innerWidth - note.offsetWidth - 8))}px`
  }
  el.onclick = ({target: {dataset: {step}}}) => {
    if (step === undefined) return
    sheet.hidePopover()
    offer.hidePopover()
    at = step === "0" ? 0 : at + Number(step)
    if (at in stops) show()
    else end()
  }
  note.onkeydown = (event) => { if (event.key === "Escape") { event.stopPropagation(); end() } }

  if (isFirst()) setTimeout(() => {
    if (!el.isConnected) return
    localStorage.setItem(TOLD, "offered")
    offer.showPopover()
  }, 2000)
  const stop = new AbortController()
  document.addEventListener("keydown", (event) => {
    const at = event.composedPath()[0]
    if (event.ctrlKey || event.metaKey || event.altKey || at.matches?.("input, textarea, select, [contenteditable]")) return
    const box = event.key === "/" && deep("input[aria-label='Find a setting']")
    if (event.key === "?") sheet.togglePopover()
    if (box) { event.preventDefault(); box.focus() }
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
    return localStorage.getItem(TOLD) === null
  } catch {
    return false
  }
}
