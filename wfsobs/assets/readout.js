// The values of all lines of a figure where the pointer is, or where the arrow keys have led a figure that has the focus.

const STEP = 0.01, LEAP = 0.1 // of the width, for an arrow key alone and with Shift

export function render({model, el}) {
  el.innerHTML = `<div class="mark" popover="manual"></div><div class="values" popover="manual"></div>`
  const [mark, box] = el.children
  const views = new WeakMap()
  let at = null // {view, share of the width} by keyboard

  const viewOf = (event) => {
    const figure = event.composedPath().find((it) => it.classList?.contains("bk-Figure"))
    if (figure && !views.has(figure)) {
      for (const view of Bokeh.index.query((it) => it.model.type === "Figure")) views.set(view.el, view)
    }
    return figure && views.get(figure)
  }

  const hide = () => {
    box.hidePopover()
    mark.hidePopover()
    box.role = null
  }

  const show = (view, sx, byKey) => {
    const rect = view.el.getBoundingClientRect(), frame = view.frame.bbox
    const lines = linesOf(view, model.labels)
    const x = view.frame.x_scale.invert(sx)
    const rows = lines.map((line) => ({...line, value: valueAt(line, x)})).filter((line) => Number.isFinite(line.value))
    if (!rows.length) return hide()
    const [across, unitX] = named(view.model.below[0]), [, unitY] = named(view.model.left[0])
    box.role = byKey ? "status" : null
    box.replaceChildren(...[{label: across, value: x, unit: unitX}, ...rows.map((row) => ({...row, unit: unitY}))].map(rowOf))
    box.showPopover()
    const room = window.innerWidth - box.offsetWidth - 4, right = rect.left + sx + 14
    box.style.left = `${right <= room ? right : Math.max(4, rect.left + sx - box.offsetWidth - 14)}px`
    box.style.top = `${Math.max(4, Math.min(rect.top + frame.top + 6, window.innerHeight - box.offsetHeight - 4))}px`
    mark.togglePopover(byKey)
    Object.assign(mark.style, {left: `${rect.left + sx}px`, top: `${rect.top + frame.top}px`, height: `${frame.height}px`})
  }

  // A line that recedes has its own colour while its card is pointed at or has the focus.
  let pointed = []
  const point = (name) => {
    if (name === pointed.name) return
    for (const [glyph, colour] of pointed) glyph.setv({line_color: colour}, {sync: false})
    const all = [...Bokeh.index.query((it) => it.model.type === "Figure")].flatMap((it) => it.model.renderers)
    const lines = name ? all.filter((it) => it.name === name && it.tags.length) : []
    pointed = lines.map(({glyph}) => [glyph, glyph.line_color])
    for (const {glyph, tags} of lines) glyph.setv({line_color: {value: tags[0]}}, {sync: false})
    pointed.name = name
  }
  const nameAt = (path) => path.find((it) => it.classList?.contains("card"))?.dataset.name

  const stop = new AbortController()
  const on = (type, heard) => document.addEventListener(type, heard, {signal: stop.signal, capture: true, passive: true})
  let moved = null
  on("keyup", (event) => point(nameAt(event.composedPath())))
  on("pointermove", (event) => {
    point(nameAt(event.composedPath()))
    const view = event.buttons ? null : viewOf(event)
    const asked = moved !== null
    moved = {view, x: event.clientX, y: event.clientY}
    if (!asked) requestAnimationFrame(() => {
      const {view, x, y} = moved
      moved = null
      const rect = view?.el.getBoundingClientRect()
      if (view && inside(view, x - rect.left, y - rect.top)) show(view, x - rect.left, false)
      else if (!at) hide()
    })
  })
  on("pointerdown", () => { at = null; hide() })
  // A box within a component scrolls without an event here: its wheel is heard.
  for (const type of ["scroll", "wheel"]) on(type, () => { at = null; if (moved) moved.view = null; hide() })
  on("keydown", (event) => {
    const step = {ArrowLeft: -1, ArrowRight: 1}[event.key]
    const view = step && viewOf(event)
    if (!view) { at = null; hide(); return }
    const share = at?.view === view ? at.share + step * (event.shiftKey ? LEAP : STEP) : 0.5
    at = {view, share: Math.min(Math.max(share, 0), 1)}
    const frame = view.frame.bbox
    show(view, frame.left + at.share * frame.width, true)
  })
  on("focusout", () => { at = null; hide() })
  model.on("remove", () => stop.abort())
}

const inside = (view, sx, sy) => {
  const {left, right, top, bottom} = view.frame.bbox
  return sx >= left && sx <= right && sy >= top && sy <= bottom
}

function linesOf(view, labels) {
  return view.model.renderers
    .filter((it) => it.visible && it.name in labels && it.glyph?.type === "Line")
    .map((it) => ({
      label: labels[it.name], colour: it.glyph.line_color?.value ?? it.glyph.line_color,
      xs: it.data_source.data[it.glyph.x.field], ys: it.data_source.data[it.glyph.y.field]}))
    .filter(({xs, ys}) => xs?.length && ys?.length === xs.length)
}

// The value of the sample that is nearest, nothing beyond the ends of the line.
function valueAt({xs, ys}, x) {
  let low = 0, high = xs.length - 1
  if (x < xs[low] || x > xs[high]) return NaN
  while (high - low > 1) {
    const middle = (low + high) >> 1
    if (xs[middle] <= x) low = middle
    else high = middle
  }
  return ys[x - xs[low] <= xs[high] - x ? low : high]
}

// What an axis is of, and its unit.
function named(axis) {
  const [, name, unit] = /^(.*?)(?:\s*\[(.*)\])?$/.exec(axis?.axis_label ?? "") ?? []
  return [name ?? "", unit ?? ""]
}

function rowOf({label, colour, value, unit}) {
  const row = Object.assign(document.createElement("div"), {innerHTML: "<i></i><span></span><b></b>"}), [swatch, name, number] = row.children
  swatch.style.background = colour ?? "transparent"
  name.textContent = label
  number.textContent = `${written(value)} ${unit}`
  return row
}

function written(value) {
  const size = Math.abs(value)
  const text = size !== 0 && (size < 1e-3 || size >= 1e5) ? value.toExponential(2) : Number(value.toPrecision(4)).toString()
  return text.replace("-", "−")
}
