// HTML that the server writes.

export function render({model, el}) {
  const draw = () => patchHtml(el, model.html)
  model.on("html", draw)
  draw()
}
