// Figures as files, with the legend that on the page the cards above them are.

const KINDS = ["svg", "png"]
const ROW = 18, SWATCH = 26, GAP = 16, MARGIN = 8
const PNG_SCALE = 3 // 400 px on the page make 1200
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
  const drawing = await svgWith(view, drawn(view, labels), await view.export("svg").to_blob())
  return kind === "svg" ? drawing : await pngOf(drawing)
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
  const [places, extra] = lines.length ? placed(lines, width) : [[], 0]
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

// The drawing at several times its size on the page.
async function pngOf(blob) {
  const url = URL.createObjectURL(blob)
  try {
    const image = new Image()
    image.src = url
    await image.decode()
    const canvas = Object.assign(document.createElement("canvas"), {width: PNG_SCALE * image.width, height: PNG_SCALE * image.height})
    canvas.getContext("2d").drawImage(image, 0, 0, canvas.width, canvas.height)
    return await new Promise((done) => canvas.toBlob(done, "image/png"))
  } finally {
    URL.revokeObjectURL(url)
  }
}
