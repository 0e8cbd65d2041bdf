// The script of a report: reads the data embedded in the page and keeps figures, their lines and the table in step with the controls.

const read = (id) => JSON.parse(document.getElementById(id).textContent)
const data = read("data"), states = read("rows"), embedded = read("figures")
const switches = [...document.querySelectorAll(".switches select")]
const shown = {state: data.start, mode: data.modes[0], over: Object.keys(data.sweeps)[0], ...Object.fromEntries(switches.map((it) => [it.name, it.value]))}
const stateShown = () => data.states[shown.state]
const unitShown = () => data.units[shown.unit]
const scaleOf = (state) => state.scale[shown.unit]  // of the unit shown, one micrometre
const boxes = [...document.querySelectorAll("[data-target] input")]  // a line each, those of both figures of the target
const boxesOf = (target) => boxes.filter((it) => it.closest("[data-target]").dataset.target === target)
const linesOf = (target) => boxesOf(target).map((it) => it.name)
const isShown = (target, name) => boxesOf(target).some((it) => it.name === name && it.checked)
const night = matchMedia("screen and (prefers-color-scheme: dark)")

const DECADES = 8  // that an axis of densities spans at most; one of amplitudes half of it
const VIEW = 2  // of a trace at first; the reset of the toolbar shows all [s]
const NONE = 65535

// Three significant digits and no exponent where it is of common size, as in the tables.
function number(value) {
  if (value === null || value === undefined) return "–"
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

function axis(name) {
  const index = stateShown().axes[name]
  return new Float32Array(index === undefined ? 0 : bytes(index))
}

// The points of a line [um], or of a density [um^2/Hz]; nothing where there is no such line.
function points(kind, target, name) {
  const line = stateShown().lines[`${kind}/${target}/${name}/${shown.mode}`]
  if (!line) return null
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

async function embed() {
  const id = "report", roots = embedded.roots
  await Bokeh.embed.embed_items({[id]: embedded.document}, [{docid: id, roots, root_ids: Object.keys(roots)}])
  return Object.fromEntries(Bokeh.documents[0].roots().map((figure) => [figure.name, figure]))
}

const lines = (figure) => figure.renderers.filter((it) => data.names.includes(it.name))

// The lines of a figure over x, and of those that are shown the lowest point but for a share of them, and the highest.
function fill(figure, target, x, share, kindOf, scale, from = -Infinity) {
  const columns = Object.fromEntries(linesOf(target).map((name) => {
    const y = points(kindOf(name), target, name)
    return [name, y ? y.map((v) => v * scale) : new Float64Array(x.length).fill(NaN)]
  }))
  lines(figure)[0].data_source.data = {x, ...columns}  // they share it
  const seen = linesOf(target).filter((name) => isShown(target, name)).map((name) => columns[name])
  const sorted = seen.map((y) => y.filter((v, i) => Number.isFinite(v) && x[i] >= from).sort()).filter((y) => y.length > 0)
  return [Math.min(...sorted.map((y) => y[Math.floor(share * y.length)])), Math.max(...sorted.map((y) => y.at(-1)))]
}

const fit = (axis, start, end) => { if (start < end) axis.setv({start, end, reset_start: start, reset_end: end}) }

function drawTrace(figure, target) {
  // What a filter does while it settles does not count.
  const {warm_up, events} = stateShown()
  const [low, high] = fill(figure, target, axis("time"), 0, () => shown.show, scaleOf(stateShown()), warm_up)
  const room = 0.05 * (high - low) || 1, top = high + room * Math.max(1, ...events.below.map((px) => 2 + px / 6))
  fit(figure.y_range, low - room, top)
  figure.renderers.find((it) => it.name === "events").data_source.data = {...events, top: events.start.map(() => top)}
  figure.left[0].axis_label = `${shown.show === "error" ? "error of " : ""}${shown.mode} [${unitShown()}]`
  const boxOf = (name) => figure.center.find((it) => it.type === "BoxAnnotation" && it.name === name)
  const [left, right] = data.window ?? [0, 0]
  boxOf("warm-up").right = warm_up
  boxOf("window").setv({left, right})
}

function drawSpectrum(figure, target) {
  const isCumulative = shown.spectrum === "cumulative", ofError = shown.show === "error"
  const kindOf = (name) => shown.spectrum + (ofError && name !== "truth" ? "-error" : "")
  const x = axis(isCumulative ? "frequency-cumulative" : "frequency"), scale = scaleOf(stateShown()) ** (isCumulative ? 1 : 2)
  const [low, high] = fill(figure, target, x, 0.02, kindOf, scale), room = isCumulative ? 1.5 : 3
  fit(figure.y_range, Math.max(low / room, high / 10 ** (isCumulative ? DECADES / 2 : DECADES)), high * room)
  const what = `${isCumulative ? "cumulative rms" : "PSD"}${ofError ? " of error" : ""}`
  figure.left[0].axis_label = `${what}, ${shown.mode} [${unitShown()}${isCumulative ? "" : "²/Hz"}]`
  for (const mark of figure.renderers.filter((it) => ["peaks", "model"].includes(it.name))) {
    const marks = stateShown()[mark.name]
    mark.data_source.data = {x: marks.map(([at]) => at), text: marks.map(([, text]) => text)}
  }
}

// The places of the sliders of every state; the last slider runs fastest.
const places = data.variations.reduce((all, texts) => all.flatMap((of) => texts.map((_, i) => [...of, i])), [[]])
const stateAt = (of) => places.findIndex((it) => it.join() === of.join())

// RMS errors over the setting chosen, the others as they stand.
function drawSweep(figure, target) {
  const [label, values] = data.sweeps[shown.over]
  const now = places[shown.state]
  const order = values.map((_, i) => i).sort((a, b) => values[a] - values[b])
  const runs = order.map((place) => stateAt(now.with(Number(shown.over), place)))
  const error = (index, name) => (rowOf(index, target, name)?.rms_um ?? NaN) * scaleOf(data.states[index])
  const columns = linesOf(target).map((name) => [name, runs.map((index) => error(index, name))])
  lines(figure)[0].data_source.data = {x: order.map((place) => values[place]), ...Object.fromEntries(columns)}
  figure.renderers.find((it) => it.name === "now").data_source.data = {x: [values[now[shown.over]]]}
  figure.below[0].axis_label = label
  figure.left[0].axis_label = `rms error, ${shown.mode} [${unitShown()}]`
}

function rowOf(index, target, name) {
  const rows = states[index].rows.filter((r) => r.target === target && r.mode === shown.mode)
  return name === "truth" ? rows.find((r) => !r.apart) : rows.find((r) => r.observer === name)
}

// Axes have their colours from the style sheet.
function paint() {
  const style = getComputedStyle(document.documentElement)
  for (const {name, glyph} of Object.values(figures).flatMap((it) => it.renderers)) {
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
  for (const it of document.querySelectorAll("canvas.paper")) it.remove()
  for (const [name, figure] of Object.entries(figures)) {
    const [view] = Bokeh.index.query((it) => it.model === figure)
    const {canvas} = view.export("png")
    canvas.className = "paper"
    canvas.removeAttribute("style")
    document.getElementById(name).after(canvas)
  }
}

function drawNumbers(target) {
  for (const it of boxesOf(target)) {
    const row = rowOf(shown.state, target, it.name) ?? rowOf(shown.state, "next z", it.name)
    const value = it.name === "truth" ? row?.truth_rms_um : row?.rms_um
    it.parentElement.querySelector("output").textContent = row ? `${number(value * scaleOf(stateShown()))} ${unitShown()}` : "–"
  }
}

function drawTable() {
  const copy = document.querySelector(`[data-state="${shown.state}"]`).cloneNode(true)
  copy.removeAttribute("data-state")
  copy.querySelector(".scroll").setAttribute("aria-label", "RMS errors")
  for (const body of copy.querySelectorAll("tbody")) body.hidden = body.dataset.mode !== shown.mode
  for (const it of copy.querySelectorAll(".unit")) it.textContent = unitShown()
  for (const it of copy.querySelectorAll("[data-um]")) it.textContent = number(Number(it.dataset.um) * scaleOf(stateShown()))
  document.getElementById("table").replaceChildren(copy)
}

let figures = {}
function drawFigures(target) {
  const [trace, spectrum, sweep] = ["trace", "spectrum", "sweep"].map((kind) => figures[`${kind}-${target}`])
  for (const it of [trace, spectrum, sweep].filter(Boolean).flatMap(lines)) it.visible = isShown(target, it.name)
  drawTrace(trace, target)
  drawSpectrum(spectrum, target)
  if (shown.over) drawSweep(sweep, target)
}

function draw() {
  for (const target of data.targets) {
    drawFigures(target)
    drawNumbers(target)
  }
  for (const it of document.querySelectorAll("[data-verdict]")) {
    it.hidden = it.dataset.verdict !== `${shown.state}` || it.dataset.mode !== shown.mode
  }
  drawTable()
}

function drawAxes() {
  const [target] = data.targets, {length} = stateShown(), f = axis("frequency")
  const view = Math.min(VIEW, length), middle = stateShown().events.start[0] ?? length / 2
  const start = Math.max(Math.min(middle - view / 2, length - view), 0)
  figures[`trace-${target}`].x_range.setv({start, end: start + view, reset_start: 0, reset_end: length})
  fit(figures[`spectrum-${target}`].x_range, f[0], f.at(-1))
}

function sliders() {
  const all = data.variations.map((_, i) => document.getElementById(`vary-${i}`))
  const say = () => all.forEach((slider, i) => {
    slider.ariaValueText = slider.nextElementSibling.textContent = data.variations[i][Number(slider.value)]
  })
  places[data.start].forEach((place, i) => { all[i].value = place })
  for (const slider of all) {
    slider.oninput = () => {
      const before = stateShown()
      shown.state = stateAt(all.map((it) => Number(it.value)))
      say()
      draw()
      if (before.length !== stateShown().length || before.dt !== stateShown().dt) drawAxes()
    }
  }
  say()
}

// What is no tilt of the wavefront has no angle.
function withoutAngle() {
  const unit = switches.find((it) => it.name === "unit")
  for (const it of unit.options) it.disabled = !data.tilts.includes(shown.mode) && data.angles.includes(it.value)
  if (unit.selectedOptions[0].disabled) unit.value = shown.unit = "nm"
}

try {
  for (const it of document.querySelectorAll("[data-state]")) it.parentElement.open = false  // the one shown stands above
  figures = await embed()
  for (const it of boxes) it.onchange = () => drawFigures(it.closest("[data-target]").dataset.target)
  sliders()
  for (const it of switches) it.onchange = () => {
    shown[it.name] = it.value
    withoutAngle()
    draw()
  }
  paint()
  drawAxes()
  draw()
  night.onchange = paint
  window.addEventListener("beforeprint", () => toPaper(true))
  window.addEventListener("afterprint", () => toPaper(false))
} catch (error) {
  document.documentElement.classList.remove("js")
  console.error(error)
}
