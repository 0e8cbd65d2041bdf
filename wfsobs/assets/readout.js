// The values of all lines of a figure where the pointer is, or where the arrow keys have led one that has the focus. The line of a
// card that is pointed at or has the focus has its own colour.

const STEP = 0.01, LEAP = 0.1 // of the width, for an arrow key alone and with Shift

export function render({model, el}) {
  el.innerHTML = `<div class="mark" popover="manual"></div><div class="values" popover="manual"></div>`
  const [mark, box] = el.children
  const views = new WeakMap() // to find one walks all of the page
  let at = null // {view, share of the width} by keyboard

  const viewOf = (event) => {
    const figure = event.composedPath().find((it) => it.classList?.contains("bk-Figure"))
    if (figure && !views.has(figure)) {
      for (const view of figureViews()) views.set(view.el, view)
    }
    return views.get(figure)
  }

  const hide = () => {
    at = null
    box.hidePopover()
    mark.hidePopover()
  }

  const show = (view, sx) => {
    const rect = view.el.getBoundingClientRect(), {frame, model: figure} = view, x = frame.x_scale.invert(sx)
    const rows = valuesAt(figure, model.labels, x)
    if (!rows.length) return hide()
    const [[across, unitX], [, unitY]] = [named(figure.below[0]), named(figure.left[0])]
    box.role = at ? "status" : null
    box.innerHTML = rowOf(across, x, unitX) + rows.map(({label, value, colour}) => rowOf(label, value, unitY, colour)).join("")
    box.showPopover()
    const room = window.innerWidth - box.offsetWidth - 4, right = rect.left + sx + 14
    box.style.left = `${right <= room ? right : Math.max(4, rect.left + sx - box.offsetWidth - 14)}px`
    box.style.top = `${Math.max(4, Math.min(rect.top + frame.bbox.top + 6, window.innerHeight - box.offsetHeight - 4))}px`
    mark.togglePopover(at !== null)
    Object.assign(mark.style, {left: `${rect.left + sx}px`, top: `${rect.top + frame.bbox.top}px`, height: `${frame.bbox.height}px`})
  }

  let pointed = []
  const point = (event) => {
    const name = event.composedPath().find((it) => it.classList?.contains("card"))?.dataset.name
    if (name === pointed.name) return
    for (const [glyph, colour] of pointed) glyph.setv({line_color: colour}, {sync: false})
    const all = name ? figureViews().flatMap((it) => it.model.renderers) : []
    const lines = all.filter((it) => it.name === name && it.tags.length)
    pointed = Object.assign(lines.map(({glyph}) => [glyph, glyph.line_color]), {name})
    for (const {glyph, tags} of lines) glyph.setv({line_color: {value: tags[0]}}, {sync: false})
  }

  const move = (event) => {
    point(event)
    const view = event.buttons ? null : viewOf(event), rect = view?.el.getBoundingClientRect()
    if (view?.frame.bbox.contains(event.clientX - rect.left, event.clientY - rect.top)) {
      at = null
      show(view, event.clientX - rect.left)
    } else if (!at) hide()
  }
  const press = (event) => {
    if (event.key === "Shift") return
    const step = {ArrowLeft: -1, ArrowRight: 1}[event.key], view = step && viewOf(event)
    if (!view) return hide()
    const share = at?.view === view ? at.share + step * (event.shiftKey ? LEAP : STEP) : 0.5, {left, width} = view.frame.bbox
    at = {view, share: Math.min(Math.max(share, 0), 1)}
    show(view, left + at.share * width)
  }
  // A box within a component scrolls without an event here: its wheel is heard.
  const away = {pointerdown: hide, scroll: hide, wheel: hide, focusout: hide}
  listen(model, {keyup: point, pointermove: move, keydown: press, ...away}, {capture: true, passive: true})
}

// What is seen of each line at the sample that is nearest, nothing beyond the ends of the line.
function valuesAt(figure, labels, x) {
  const lines = figure.renderers.filter((it) => it.visible && it.name in labels && it.glyph?.type === "Line")
  const rows = lines.map(({name, glyph, data_source: {data}}) => {
    const xs = data[glyph.x.field], ys = data[glyph.y.field], i = xs?.findLastIndex((it) => it <= x) ?? -1
    const isNext = xs?.[i + 1] - x < x - xs?.[i]
    return {label: labels[name], colour: glyph.line_color?.value ?? glyph.line_color, value: i < 0 || x > xs.at(-1) ? NaN : ys[i + isNext]}
  })
  return rows.filter(({value}) => Number.isFinite(value))
}

// What an axis is of, and its unit.
function named(axis) {
  const [, name, unit] = /^(.*?)(?:\s*\[(.*)\])?$/.exec(axis?.axis_label ?? "") ?? []
  return [name ?? "", unit ?? ""]
}

function rowOf(label, value, unit, colour = "transparent") {
  const size = Math.abs(value), isCommon = size === 0 || (size >= 1e-3 && size < 1e5)
  const number = (isCommon ? `${Number(value.toPrecision(4))}` : value.toExponential(2)).replace("-", "−")
  const text = label.replaceAll("&", "&amp;").replaceAll("<", "&lt;") // a package may have any
  return `<div><i style="background: ${colour}"></i><span>${text}</span><b>${number} ${unit}</b></div>`
}
