// The script of a report: reads the data embedded in the page and keeps figures, their lines and the table in step with the controls.

const read = (id) => JSON.parse(document.getElementById(id).textContent)
const data = read("data"), states = read("rows"), embedded = read("figures")
const all = (selector, within = document) => [...within.querySelectorAll(selector)]
const sliders = all(".slider input"), switches = all(".switches select"), boxes = all(".lines input")
const boxesOf = (target) => all(`.lines[data-target="${target}"] input`)  // a line each, of all figures of the target
const figureOf = (name) => Bokeh.documents[0].get_model_by_name(name)
const night = matchMedia("screen and (prefers-color-scheme: dark)")

// The places of the sliders of every state; the last slider runs fastest.
const places = data.variations.reduce((found, texts) => found.flatMap((of) => texts.map((_, i) => [...of, i])), [[]])
const stateAt = (place) => places.findIndex((it) => it.join() === place.join())
const shown = {over: Object.keys(data.sweeps)[0]}  // also what each switch says
let state, scale  // shown; of its unit, one micrometre

const DECADES = 8  // that an axis of densities spans at most; one of amplitudes half of it
const VIEW = 2  // of a trace at first; the reset of the toolbar shows all [s]
const NONE = 65535

// Three significant digits and no exponent where it is of common size, as in the tables.
function number(value) {
  if (value === 0) return "0"
  const size = Math.abs(value)
  if (size < 1e-4 || size >= 1e6) return value.toExponential(2).replace(/e([+-])(\d)$/, "e$10$2")
  const text = value.toPrecision(3)
  return (text.includes("e") ? value.toFixed(0) : text).replace("-", "−")
}

const packed = Uint8Array.from(atob(data.arrays), (c) => c.charCodeAt(0))
const pool = await new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"))).arrayBuffer()
const ends = data.lengths.reduce((sums, length) => [...sums, sums.at(-1) + length], [0])
const bytes = (index) => pool.slice(ends[index], ends[index + 1])
const axis = (name) => new Float32Array(name in state.axes ? bytes(state.axes[name]) : 0)

// The points of a line [um], or of a density [um^2/Hz]; nothing where there is no such line.
function points(kind, target, name) {
  const line = state.lines[`${kind}/${target}/${name}/${shown.mode}`]
  if (!line) return []
  const [index, low, step] = line, raw = new Uint8Array(bytes(index)), n = raw.length / 2
  const isLogarithmic = /^(psd|cumulative)/.test(kind)
  let level = 0
  return Float64Array.from({length: n}, (_, i) => {
    const change = raw[i] | raw[n + i] << 8
    level = level + (change >> 1 ^ -(change & 1)) & NONE
    const value = level === NONE ? NaN : low + step * level
    return isLogarithmic ? 10 ** value : value
  })
}

const lines = (figure) => figure.renderers.filter((it) => data.names.includes(it.name))
const partOf = (parts, name) => parts.find((it) => it.name === name)
const fit = (axis, start, end) => { if (start < end) axis.setv({start, end, reset_start: start, reset_end: end}) }

// The lines of a figure over x, and of those that are shown the lowest point but for a share of them, and the highest.
function fill(figure, target, x, share, kindOf, unit, from = -Infinity) {
  const of = boxesOf(target).map(({name, checked}) => {
    const y = points(kindOf(name), target, name)
    return {name, checked, y: Float64Array.from(x, (_, i) => (y[i] ?? NaN) * unit)}
  })
  lines(figure)[0].data_source.data = {x, ...Object.fromEntries(of.map(({name, y}) => [name, y]))}  // they share it
  const seen = of.filter((it) => it.checked).map(({y}) => y.filter((v, i) => Number.isFinite(v) && x[i] >= from).sort())
  const sorted = seen.filter((y) => y.length > 0)
  return [Math.min(...sorted.map((y) => y[Math.floor(share * y.length)])), Math.max(...sorted.map((y) => y.at(-1)))]
}

function drawTrace(figure, target) {
  // What a filter does while it settles does not count.
  const {warm_up, events} = state
  const [low, high] = fill(figure, target, axis("time"), 0, () => shown.show, scale, warm_up)
  const room = 0.05 * (high - low) || 1, top = high + room * Math.max(1, ...events.below.map((px) => 2 + px / 6))
  fit(figure.y_range, low - room, top)
  partOf(figure.renderers, "events").data_source.data = {...events, top: events.start.map(() => top)}
  figure.left[0].axis_label = `${shown.show === "error" ? "error of " : ""}${shown.mode} [${data.units[shown.unit]}]`
  const [left, right] = data.window ?? [0, 0]
  partOf(figure.center, "warm-up").right = warm_up
  partOf(figure.center, "window").setv({left, right})
}

function drawSpectrum(figure, target) {
  const isCumulative = shown.spectrum === "cumulative", ofError = shown.show === "error"
  const kindOf = (name) => shown.spectrum + (ofError && name !== "truth" ? "-error" : "")
  const x = axis(isCumulative ? "frequency-cumulative" : "frequency")
  const [low, high] = fill(figure, target, x, 0.02, kindOf, scale ** (isCumulative ? 1 : 2)), room = isCumulative ? 1.5 : 3
  fit(figure.y_range, Math.max(low / room, high / 10 ** (isCumulative ? DECADES / 2 : DECADES)), high * room)
  const what = `${isCumulative ? "cumulative rms" : "PSD"}${ofError ? " of error" : ""}`
  figure.left[0].axis_label = `${what}, ${shown.mode} [${data.units[shown.unit]}${isCumulative ? "" : "²/Hz"}]`
  for (const {name, data_source} of figure.renderers.filter((it) => ["peaks", "model"].includes(it.name))) {
    data_source.data = {x: state[name].map(([at]) => at), text: state[name].map(([, text]) => text)}
  }
}

// RMS errors over the setting chosen, the others as they stand.
function drawSweep(figure, target) {
  const [label, values] = data.sweeps[shown.over], now = places[shown.state]
  const order = values.map((_, i) => i).sort((a, b) => values[a] - values[b])
  const runs = order.map((place) => stateAt(now.with(Number(shown.over), place)))
  const error = (index, name) => (rowOf(index, target, name)?.rms_um ?? NaN) * data.states[index].scale[shown.unit]
  const columns = boxesOf(target).map(({name}) => [name, runs.map((index) => error(index, name))])
  lines(figure)[0].data_source.data = {x: order.map((place) => values[place]), ...Object.fromEntries(columns)}
  partOf(figure.renderers, "now").data_source.data = {x: [values[now[shown.over]]]}
  figure.below[0].axis_label = label
  figure.left[0].axis_label = `rms error, ${shown.mode} [${data.units[shown.unit]}]`
}

function rowOf(index, target, name) {
  const rows = states[index].rows.filter((r) => r.target === target && r.mode === shown.mode)
  return name === "truth" ? rows.find((r) => !r.apart) : rows.find((r) => r.observer === name)
}

// Axes have their colours from the style sheet.
function paint() {
  const style = getComputedStyle(document.documentElement)
  for (const {name, glyph} of Bokeh.documents[0].roots().flatMap((it) => it.renderers)) {
    const value = style.getPropertyValue(`--line-${name}`)
    const keys = ["line_color", "fill_color", "text_color"].filter((key) => value && key in glyph.properties)
    glyph.setv(Object.fromEntries(keys.map((key) => [key, {value}])))
  }
}

// Figures are as wide as the window: on paper stands a picture of each, as wide as the page has room, in the colours of light mode.
function toPaper(isPaper) {
  document.documentElement.classList.toggle("paper", isPaper)
  paint()
  if (!isPaper) return
  for (const it of all("canvas.paper")) it.remove()
  for (const view of Bokeh.index.query((it) => it.model.type === "Figure")) {
    const {canvas} = view.export("png")
    canvas.className = "paper"
    canvas.removeAttribute("style")
    document.getElementById(view.model.name).after(canvas)
  }
}

function drawNumbers(target) {
  for (const it of boxesOf(target)) {
    const row = rowOf(shown.state, target, it.name) ?? rowOf(shown.state, "next z", it.name)
    const value = it.name === "truth" ? row?.truth_rms_um : row?.rms_um
    all("output", it.parentElement)[0].textContent = value == null ? "–" : `${number(value * scale)} ${data.units[shown.unit]}`
  }
}

function drawTable() {
  const copy = document.querySelector(`[data-state="${shown.state}"]`).cloneNode(true)
  copy.removeAttribute("data-state")
  copy.querySelector(".scroll").ariaLabel = "RMS errors"
  for (const body of all("tbody", copy)) body.hidden = body.dataset.mode !== shown.mode
  for (const it of all(".unit", copy)) it.textContent = data.units[shown.unit]
  for (const it of all("[data-um]", copy)) it.textContent = number(it.dataset.um * scale)
  document.getElementById("table").replaceChildren(copy)
}

// What the ranges of the axes depend on.
const rangesOf = (it) => [it?.length, it?.dt, it?.events.start[0]].join()

function drawAxes() {
  const [target] = data.targets, {length} = state, f = axis("frequency")
  const view = Math.min(VIEW, length), middle = state.events.start[0] ?? length / 2
  const start = Math.max(Math.min(middle - view / 2, length - view), 0)
  figureOf(`trace-${target}`).x_range.setv({start, end: start + view, reset_start: 0, reset_end: length})
  fit(figureOf(`spectrum-${target}`).x_range, f[0], f.at(-1))
}

function draw() {
  const before = state, unit = switches.find((it) => it.name === "unit")
  for (const it of switches) shown[it.name] = it.value
  // What is no tilt of the wavefront has no angle.
  for (const it of unit.options) it.disabled = !data.tilts.includes(shown.mode) && data.angles.includes(it.value)
  if (unit.selectedOptions[0].disabled) unit.value = shown.unit = "nm"
  sliders.forEach((it, i) => { it.ariaValueText = it.nextElementSibling.textContent = data.variations[i][it.value] })
  shown.state = stateAt(sliders.map((it) => it.value))
  state = data.states[shown.state]
  scale = state.scale[shown.unit]
  for (const target of data.targets) {
    const [trace, spectrum, sweep] = ["trace", "spectrum", "sweep"].map((kind) => figureOf(`${kind}-${target}`))
    const isShown = Object.fromEntries(boxesOf(target).map(({name, checked}) => [name, checked]))
    for (const it of [trace, spectrum, sweep].filter(Boolean).flatMap(lines)) it.visible = isShown[it.name] ?? false
    drawTrace(trace, target)
    drawSpectrum(spectrum, target)
    if (shown.over) drawSweep(sweep, target)
    drawNumbers(target)
  }
  for (const it of all("[data-verdict]")) it.hidden = it.dataset.verdict !== `${shown.state}` || it.dataset.mode !== shown.mode
  drawTable()
  if (rangesOf(before) !== rangesOf(state)) drawAxes()
}

try {
  for (const it of all("[data-state]")) it.parentElement.open = false  // the one shown stands above
  await Bokeh.embed.embed_items({report: embedded.document}, [{docid: "report", roots: embedded.roots, root_ids: Object.keys(embedded.roots)}])
  places[data.start].forEach((place, i) => { sliders[i].value = place })
  for (const it of sliders) it.oninput = draw
  for (const it of [...switches, ...boxes]) it.onchange = draw
  paint()
  draw()
  night.onchange = paint
  window.addEventListener("beforeprint", () => toPaper(true))
  window.addEventListener("afterprint", () => toPaper(false))
} catch (error) {
  document.documentElement.classList.remove("js")
  console.error(error)
}
