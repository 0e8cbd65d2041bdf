// Figures as files, with the legend that on the page the cards above them are.

const KINDS = ["svg", "png"]
const ROW = 18, SWATCH = 26, GAP = 16, MARGIN = 8
const FONT = "12px Helvetica, Arial, sans-serif"

function figures() {
  const seen = (view) => view.model.type === "Figure" && view.el.getBoundingClientRect().width > 0
  const views = [...Bokeh.index.query(seen)]
  return views.map((view) => {
    const axes = [view.model.left[0]?.axis_label, view.model.below[0]?.axis_label]
    return [view.model.name ?? axes.filter(Boolean).join(" over "), view]
  })
}

// The figure as a blob, its legend above it. labels: name of a line -> what it is called.
async function exported(view, kind, labels) {
  const blob = await view.export(kind).to_blob()
  const lines = drawn(view, labels)
  if (lines.length === 0) return blob
  return kind === "svg" ? await svgWith(view, lines, blob) : await pngWith(view, lines, blob)
}

const plain = (property) => property?.value !== undefined ? property.value : property

function drawn(view, labels) {
  const some = (values) => values !== undefined && [...values].some(Number.isFinite)
  return view.model.renderers
    .filter((it) => it.visible && it.name in labels && it.glyph?.type === "Line" && some(it.data_source.data[it.glyph.y.field]))
    .map((it) => ({
      label: labels[it.name], colour: plain(it.glyph.line_color), width: plain(it.glyph.line_width),
      dash: [plain(it.glyph.line_dash) ?? []].flat().filter(Number.isFinite),
    }))
}

// Places of the entries in rows no wider than the figure, and the height of them all.
function placed(lines, width) {
  const pen = document.createElement("canvas").getContext("2d")
  pen.font = FONT
  let x = MARGIN, y = MARGIN
  const places = lines.map((line) => {
    const wide = SWATCH + 6 + pen.measureText(line.label).width
    if (x + wide > width - MARGIN && x > MARGIN) [x, y] = [MARGIN, y + ROW]
    const place = {...line, x, y: y + ROW / 2}
    x += wide + GAP
    return place
  })
  return [places, y + ROW + 4]
}

const inks = (view) => [
  plain(view.model.border_fill_color) ?? "#ffffff", plain(view.model.below[0]?.axis_label_text_color) ?? "#444444"]

async function svgWith(view, lines, blob) {
  const page = new DOMParser().parseFromString(await blob.text(), "image/svg+xml")
  const svg = page.documentElement
  const width = Number(svg.getAttribute("width")), height = Number(svg.getAttribute("height"))
  const [places, extra] = placed(lines, width)
  const [paper, ink] = inks(view)
  const make = (name, attributes, text = "") => {
    const it = page.createElementNS("http://www.w3.org/2000/svg", name)
    for (const [key, value] of Object.entries(attributes)) it.setAttribute(key, value)
    it.textContent = text
    return it
  }
  const moved = make("g", {transform: `translate(0, ${extra})`})
  moved.append(...svg.childNodes)
  svg.append(make("rect", {width, height: height + extra, fill: paper}), moved)
  for (const {label, colour, width: thick, dash, x, y} of places) {
    const stroke = {stroke: colour, "stroke-width": thick, "stroke-dasharray": dash.join(" ") || "none"}
    svg.append(make("line", {x1: x, x2: x + SWATCH, y1: y, y2: y, ...stroke}),
               make("text", {x: x + SWATCH + 6, y: y + 4, fill: ink, style: `font: ${FONT}`}, label))
  }
  svg.setAttribute("height", height + extra)
  return new Blob([new XMLSerializer().serializeToString(page)], {type: "image/svg+xml"})
}

async function pngWith(view, lines, blob) {
  const image = await createImageBitmap(blob)
  const scale = image.width / view.el.getBoundingClientRect().width
  const [places, extra] = placed(lines, image.width / scale)
  const [paper, ink] = inks(view)
  const canvas = Object.assign(document.createElement("canvas"), {
    width: image.width, height: image.height + Math.round(extra * scale)})
  const pen = canvas.getContext("2d")
  pen.fillStyle = paper
  pen.fillRect(0, 0, canvas.width, canvas.height)
  pen.drawImage(image, 0, Math.round(extra * scale))
  pen.scale(scale, scale)
  Object.assign(pen, {font: FONT, fillStyle: ink})
  for (const {label, colour, width, dash, x, y} of places) {
    pen.fillText(label, x + SWATCH + 6, y + 4)
    Object.assign(pen, {strokeStyle: colour, lineWidth: width})
    pen.setLineDash(dash)
    pen.beginPath()
    pen.moveTo(x, y)
    pen.lineTo(x + SWATCH, y)
    pen.stroke()
  }
  return await new Promise((done) => canvas.toBlob(done, "image/png"))
}

