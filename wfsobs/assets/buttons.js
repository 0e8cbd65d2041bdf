// HTML of the server, with buttons in it.

export function render({model, el}) {
  showMarkup(el, model)
}
