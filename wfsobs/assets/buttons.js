// HTML of the server with buttons in it.

export function render({model, el}) {
  const draw = () => setMarkup(el, model.html)
  tellActions(el, model)
  model.on("html", draw)
  draw()
}
