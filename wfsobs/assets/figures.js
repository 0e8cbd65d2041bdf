// Figures as SVG, with a legend in place of the cards above them.

const ENTRY = 170 // of the legend [px]

function figures() {
  return figureViews().filter((it) => it.el.checkVisibility()).map((view) => {
    const axes = [view.model.left[0]?.axis_label, view.model.below[0]?.axis_label]
    return [view.model.name ?? axes.filter(Boolean).join(" over "), view]
  })
}

// The figure as a blob, with its legend. labels: name of a line -> what it is called.
async function exported(view, labels) {
  const [Legend, LegendItem] = ["Legend", "LegendItem"].map((it) => Bokeh.Models.get(it)), {above} = view.model
  const isDrawn = ({glyph, data_source}) => glyph.type === "Line" && [...data_source.data[glyph.y.field] ?? []].some(Number.isFinite)
  const lines = new Map(view.model.renderers.filter((it) => it.visible && it.name in labels && isDrawn(it)).map((it) => [it.name, it]))
  const items = [...lines].map(([name, it]) => new LegendItem({label: {value: labels[name]}, renderers: [it]}))
  const ncols = Math.max(1, Math.floor(view.frame.bbox.width / ENTRY))
  const legend = new Legend({items, ncols, margin: 0, border_line_color: null})
  Object.defineProperty(legend, "is_syncable", {value: false})  // the server does not know it
  view.model.setv({above: [...above, legend]}, {sync: false})
  for (let frames = 0; frames < 3; frames++) await new Promise(requestAnimationFrame)  // until it has its room
  const blob = await view.export("svg").to_blob()
  view.model.setv({above}, {sync: false})
  return blob
}

function save(name, blob) {
  const url = URL.createObjectURL(blob)
  Object.assign(document.createElement("a"), {href: url, download: name}).click()
  setTimeout(() => URL.revokeObjectURL(url), 60_000)
}
