// Handles over a spectrum: drag one, or move it with the arrow keys, and the server says what theory expects of the settings it
// would make; let go, and the settings are those. Where handles are is the server's to say: this sends wishes, one at a time, the
// newest of those that came up meanwhile, and shows a handle where the pointer is until it is let go.

const SETTLE = 700  // keys: the move is over after this time without one [ms]
const STEPS = {frequency: 1.005, strength: 1.06, damping: 1.12}, LEAP = 4  // as many at once with Shift
const KEYS = {
  ArrowRight: ["frequency", 1], ArrowLeft: ["frequency", -1], ArrowUp: ["strength", 1], ArrowDown: ["strength", -1],
  PageUp: ["damping", 1], PageDown: ["damping", -1]}
const DEAD = 3  // px that a pointer may tremble

export function render({model, el}) {
  patchHtml(el, model.html)
  const root = el.firstElementChild, [marks, bar] = root.children
  let view = null, number = 0, waiting = 0, newest = null, settle = 0
  let move = null  // {handle, frequency, strength, damping}; by pointer also where it was taken and how far it is from there
  let adding = 0  // how many handles there are with the one that is being added

  const handles = () => model.frame.handles ?? []
  const handleOf = (it) => handles()[[...marks.children].indexOf(it)]

  const send = (message) => {
    if (!waiting) model.send_msg({...message, number: waiting = ++number})
    else if (!newest?.last || message.last) newest = message
    el.classList.add("pending")
  }
  const hear = () => {
    if (!waiting || model.frame.answered < waiting) return
    const next = newest
    waiting = newest = null
    el.classList.remove("pending")
    if (next) send(next)
  }
  const wish = (action) => {
    const {handle: {id}, frequency, strength, damping} = move
    send({action, last: action === "release", id, frequency, strength, damping})
  }
  const end = (action) => {
    clearTimeout(settle)
    if (action === "cancel" && move) send({action, last: true})
    else if (move?.changed) wish(action)
    move = null
    place()
  }
  const take = (handle) => {
    if (move && move.handle.id !== handle.id) end("release")
    move ??= {handle, frequency: handle.frequency, strength: 1, damping: 1}
  }
  const change = (changes) => {
    Object.assign(move, changes, {changed: true})
    const {start, end} = view.model.x_range
    move.frequency = Math.min(Math.max(move.frequency, start), end, move.handle.highest ?? Infinity)
    wish("drag")
  }

  const find = () => {
    const found = figureViews().find((it) => it.model.name === model.figure)
    if (!found?.frame?.bbox?.width) return setTimeout(find, 50)
    view = found
    for (const range of [view.model.x_range, view.model.y_range]) range.change.connect(soon)
    new ResizeObserver(soon).observe(view.el)
    place()
  }
  let asked = 0
  const soon = () => {
    cancelAnimationFrame(asked)
    asked = requestAnimationFrame(place)
  }
  const place = () => {
    if (!view) return
    const here = root.getBoundingClientRect(), there = view.el.getBoundingClientRect()
    const {bbox: box, x_scale, y_scale} = view.frame
    for (const it of marks.children) {
      const handle = handleOf(it)
      it.hidden = !handle
      if (!handle) continue
      const own = {model: box.bottom - 28, band: box.bottom - 9}[handle.kind]
      let sx = x_scale.compute(handle.frequency)
      let sy = own ?? (Number.isFinite(handle.y) ? y_scale.compute(handle.y) : (box.top + box.bottom) / 2)
      if (move?.changed && move.from && move.handle.id === handle.id) {
        sx = x_scale.compute(move.frequency)
        if (handle.strength) sy = move.from.sy + move.dy
      }
      it.hidden = sx < box.left - 1 || sx > box.right + 1
      it.style.left = `${there.left - here.left + sx}px`
      it.style.top = `${there.top - here.top + Math.min(Math.max(sy, box.top + 6), box.bottom - 6)}px`
    }
  }

  const draw = () => {
    patchHtml(el, model.html)
    hear()
    place()
    if (!adding || Math.min(marks.children.length, handles().length) < adding) return  // HTML and frame come one after the other
    marks.children[handles().findIndex(({id}) => id === model.frame.added)]?.focus()
    adding = 0
  }

  marks.onpointerdown = (event) => {
    const handle = handleOf(event.target)
    if (event.button || !view || !handle) return
    event.preventDefault()
    event.target.focus()
    event.target.setPointerCapture(event.pointerId)
    take(handle)
    const top = view.el.getBoundingClientRect().top - root.getBoundingClientRect().top
    move.from = {x: event.clientX, y: event.clientY, sx: view.frame.x_scale.compute(move.frequency), sy: parseFloat(event.target.style.top) - top}
  }
  marks.onpointermove = (event) => {
    if (!move?.from) return
    const {from, handle} = move, {x_scale, y_scale, bbox} = view.frame
    const dx = event.clientX - from.x, dy = event.clientY - from.y, at = bbox.bottom - 50
    if (!move.changed && Math.hypot(dx, dy) < DEAD) return
    const frequency = Math.abs(dx) < DEAD ? handle.frequency : x_scale.invert(from.sx + dx)
    const isRaised = handle.strength && Math.abs(dy) >= DEAD
    change({dy, frequency, strength: isRaised ? (y_scale.invert(at + dy) / y_scale.invert(at)) ** model.frame.exponent : 1})
    place()
  }
  marks.onpointerup = () => end("release")
  marks.onpointercancel = () => end("cancel")
  marks.onkeydown = (event) => {
    const handle = handleOf(event.target), [what, sign] = KEYS[event.key] ?? []
    if (event.key === "Escape") end("cancel")
    else if (event.key === "Enter") end("release")
    else if (event.key === "Delete" && handle.kind === "peak") {
      bar.querySelector(".add").focus()  // a place to go on from
      send({action: "remove", last: true, id: handle.id})
    } else if (what && (what === "frequency" || handle[what])) {
      event.preventDefault()
      event.stopPropagation()
      take(handle)
      const step = STEPS[what] ** (event.shiftKey ? LEAP : 1)
      change({[what]: move[what] * step ** (sign * Math.sign(move[what]))})  // to the right, also where numbers are below zero
      clearTimeout(settle)
      settle = setTimeout(() => end("release"), SETTLE)
    }
  }
  marks.addEventListener("focusout", () => { if (move && !move.from) end("release") })
  bar.onclick = ({target}) => {
    if (!view || !target.matches(".add")) return
    const {start, end} = view.model.x_range
    adding = handles().length + 1
    send({action: "add", last: true, frequency: Math.sqrt(start * end)})
  }

  model.on(["frame", "html"], draw)
  draw()
  find()
}
