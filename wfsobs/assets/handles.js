// Handles over a spectrum: drag one, or move it with the arrow keys, and the server says what theory expects of the settings it
// would make; let go, and the settings are those. Where handles are and what they are called is the server's to say: this sends
// wishes, one at a time, the newest of those that came up meanwhile, and shows a handle where the pointer is until the answer.

const LATE = 150  // an answer that takes longer is marked as pending [ms]
const LOST = 5000  // one that takes longer is no longer waited for [ms]
const SETTLE = 700  // keys: the move is over after this time without one [ms]
const NUDGE = 1.005, LEAP = 1.05, STRONGER = 1.06, BROADER = 1.12
const DEAD = 3  // px that a pointer may tremble

export function render({model, el}) {
  el.innerHTML = `<div class="root"><div class="marks"><div class="room"></div></div><div class="bar"></div><span class="away"></span></div>`
  const root = el.firstChild, [marks, bar, away] = root.children, room = marks.firstChild
  const addButton = () => bar.querySelector(".add")

  let view = null, elements = new Map(), number = 0, waiting = 0, newest = null, late = 0, lost = 0, settle = 0
  let move = null  // {id, frequency, strength, damping, byKey, x, y}
  let wantsLast = false
  let orphan = null  // the handle that had the focus when it went

  // ------------------------------------------------------------------ messages

  const send = (message) => {
    if (waiting) {
      if (!newest?.last || message.last) newest = message
      return
    }
    waiting = message.number = ++number
    model.send_msg(message)
    late = setTimeout(() => root.classList.add("pending"), LATE)
    lost = setTimeout(() => answered(), LOST)
  }
  const answered = () => {
    clearTimeout(late)
    clearTimeout(lost)
    waiting = 0
    root.classList.remove("pending")
    const next = newest
    newest = null
    if (next) send(next)
  }
  const wish = (last) => send({
    action: last ? "release" : "drag", last, id: move.id, frequency: move.frequency, strength: move.strength, damping: move.damping})
  const release = () => {
    clearTimeout(settle)
    if (!move) return
    const changed = move.changed
    if (changed) wish(true)
    elements.get(move.id)?.classList.remove("held")
    move = null
    if (!changed) place()
  }
  const cancel = () => {
    clearTimeout(settle)
    if (!move) return
    elements.get(move.id)?.classList.remove("held")
    move = null
    newest = null
    send({action: "cancel", last: true})
  }
  const take = (handle, byKey) => {
    if (move && move.id !== handle.id) release()
    move ??= {id: handle.id, frequency: handle.frequency, strength: 1, damping: 1, byKey, changed: false}
    elements.get(handle.id).classList.add("held")
  }
  const later = () => { clearTimeout(settle); settle = setTimeout(release, SETTLE) }

  // ------------------------------------------------------------------ where things are

  const find = () => {
    const [found] = Bokeh.index.query((it) => it.model.type === "Figure" && it.model.name === model.figure)
    if (!found?.frame?.bbox?.width) return setTimeout(find, 50)
    view = found
    for (const range of [view.model.x_range, view.model.y_range]) range.change.connect(soon)
    new ResizeObserver(soon).observe(view.el)
    place()
  }
  let asked = false
  const soon = () => {
    if (asked || !view) return
    asked = true
    requestAnimationFrame(() => { asked = false; place() })
  }
  const place = () => {
    if (!view) return
    const here = root.getBoundingClientRect(), there = view.el.getBoundingClientRect(), box = view.frame.bbox
    const {x_scale, y_scale} = view.frame
    let outside = 0
    for (const handle of model.frame.handles ?? []) {
      const it = elements.get(handle.id)
      if (!it) continue
      const held = move?.id === handle.id
      const sx = x_scale.compute(held ? move.frequency : handle.frequency)
      let sy = {model: box.bottom - 28, band: box.bottom - 9}[handle.kind] ?? (Number.isFinite(handle.y) ? y_scale.compute(handle.y) : (box.top + box.bottom) / 2)
      if (held && move.sy !== undefined && handle.strength) sy = move.sy
      it.hidden = sx < box.left - 1 || sx > box.right + 1
      outside += it.hidden
      it.style.left = `${there.left - here.left + sx}px`
      it.style.top = `${there.top - here.top + Math.min(Math.max(sy, box.top + 6), box.bottom - 6)}px`
    }
    away.textContent = outside ? `Outside of the zoom: ${outside} more. A double click on the figure shows all.` : ""
  }

  // ------------------------------------------------------------------ a handle

  const current = (id) => model.frame.handles.find((it) => it.id === id)
  const limits = () => [view.model.x_range.start, view.model.x_range.end]
  const within = (x, handle) => Math.min(Math.max(x, limits()[0]), limits()[1], handle.highest ?? Infinity)

  const handleOf = (id) => {
    const it = Object.assign(document.createElement("div"), {className: "handle", tabIndex: 0, role: "slider"})
    it.dataset.id = id
    marks.append(it)
    let start = null
    it.onpointerdown = (event) => {
      if (event.button || !view) return
      event.preventDefault()
      it.focus()
      it.setPointerCapture(event.pointerId)
      take(current(id), false)
      start = {x: event.clientX, y: event.clientY, sx: view.frame.x_scale.compute(move.frequency), top: parseFloat(it.style.top)}
    }
    it.onpointermove = (event) => {
      if (!start || !move) return
      const dx = event.clientX - start.x, dy = event.clientY - start.y, {x_scale, y_scale} = view.frame
      if (!move.changed && Math.hypot(dx, dy) < DEAD) return
      move.changed = true
      if (Math.abs(dx) >= DEAD) move.frequency = within(x_scale.invert(start.sx + dx), current(id))
      if (current(id).strength && Math.abs(dy) >= DEAD) {
        const at = view.frame.bbox.bottom - 50
        move.strength = (y_scale.invert(at + dy) / y_scale.invert(at)) ** model.frame.exponent
        const origin = view.el.getBoundingClientRect().top - root.getBoundingClientRect().top
        move.sy = start.top + dy - origin
      }
      place()
      wish(false)
    }
    it.onpointerup = () => { start = null; release() }
    it.onpointercancel = () => { start = null; cancel() }
    it.addEventListener("wheel", (event) => {
      if (!current(id).damping) return
      event.preventDefault()
      take(current(id), true)
      move.damping *= event.deltaY < 0 ? BROADER : 1 / BROADER
      move.changed = true
      wish(false)
      if (!start) later()
    }, {passive: false})
    it.onkeydown = (event) => {
      const handle = current(id), leap = event.shiftKey
      if (event.key === "Escape") return cancel()
      if (event.key === "Enter") return release()
      if (event.key === "Delete" && handle.kind === "peak") {
        event.preventDefault()
        addButton().focus()  // a place to go on from
        return send({action: "remove", last: true, id})
      }
      const [what, sign] = {
        ArrowRight: ["frequency", 1], ArrowLeft: ["frequency", -1], ArrowUp: ["strength", 1], ArrowDown: ["strength", -1],
        PageUp: ["damping", 1], PageDown: ["damping", -1]}[event.key] ?? []
      if (!what || (what !== "frequency" && !handle[what])) return
      event.preventDefault()
      event.stopPropagation()
      take(handle, true)
      const step = {frequency: leap ? LEAP : NUDGE, strength: leap ? STRONGER ** 4 : STRONGER, damping: BROADER}[what]
      move[what] *= step ** (sign * Math.sign(move[what]))  // to the right, also where numbers are below zero
      if (what === "frequency") move[what] = within(move[what], handle)
      move.changed = true
      place()
      wish(false)
      later()
    }
    it.onblur = () => { if (move?.byKey) release() }
    return it
  }

  // ------------------------------------------------------------------ what the server says

  const draw = () => {
    const frame = model.frame
    if (waiting && frame.answered >= waiting) answered()
    const kept = new Map()
    for (const handle of frame.handles ?? []) {
      const it = elements.get(handle.id) ?? handleOf(handle.id)
      kept.set(handle.id, it)
      it.classList.add(handle.kind)
      Object.assign(it, {
        title: `${handle.label}: ${handle.text}`, ariaLabel: handle.label, ariaValueText: handle.text, ariaValueNow: handle.frequency,
        ariaValueMin: frame.limits[0], ariaValueMax: handle.highest ?? frame.limits[1]})
    }
    const focused = root.getRootNode().activeElement
    for (const [id, it] of elements) {
      if (kept.has(id)) continue
      if (it === focused) orphan = id
      it.remove()
    }
    const more = kept.size > elements.size
    elements = kept
    if (elements.has(orphan)) {  // it is back: who was at it goes on, unless elsewhere by now
      if (document.activeElement === document.body) elements.get(orphan).focus()
      orphan = null
    }
    if (wantsLast && more) {
      wantsLast = false
      elements.get(frame.added)?.focus()
    }
    place()
  }
  const write = () => {
    patchHtml(bar, model.html)
    addButton().ariaPressed = marks.classList.contains("armed")
  }

  // ------------------------------------------------------------------ one more peak

  const arm = (on) => {
    addButton().ariaPressed = on
    marks.classList.toggle("armed", on)
    if (!on) return
    const here = root.getBoundingClientRect(), there = view.el.getBoundingClientRect(), box = view.frame.bbox
    marks.style.setProperty("--left", `${there.left - here.left + box.left}px`)
    marks.style.setProperty("--top", `${there.top - here.top + box.top}px`)
    marks.style.setProperty("--width", `${box.width}px`)
    marks.style.setProperty("--height", `${box.height}px`)
  }
  bar.onclick = (event) => {
    if (!view || event.target !== addButton()) return
    if (event.detail === 0) {  // by keyboard
      wantsLast = true
      const [low, high] = limits()
      return send({action: "add", last: true, frequency: Math.sqrt(low * high)})
    }
    arm(!marks.classList.contains("armed"))
  }
  room.onclick = (event) => {
    const there = view.el.getBoundingClientRect(), {x_scale, y_scale} = view.frame
    wantsLast = true
    arm(false)
    send({action: "add", last: true, frequency: x_scale.invert(event.clientX - there.left), height: y_scale.invert(event.clientY - there.top)})
  }
  root.onkeydown = (event) => { if (event.key === "Escape") arm(false) }

  model.on("frame", draw)
  model.on("html", write)
  write()
  draw()
  find()
}
