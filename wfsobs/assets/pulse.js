// Answers each picture once it has been painted; the next one waits for that. A page that sleeps paints nothing, so that none are
// kept for it, and it is sent the present when it wakes.

// Make the changes of a picture: for each model its id, the columns and their length, or properties and their values; the numbers
// of all columns lie one after the other. They come from the server, which is not told of them.
function change([steps, numbers]) {
  const all = new Float32Array(numbers.buffer, numbers.byteOffset, numbers.length)
  let at = 0
  for (const [id, columns, n, values] of steps) {
    const data = Object.fromEntries(columns.map((name) => [name, all.slice(at, (at += n))]))
    const model = Bokeh.documents.map((it) => it.get_model_by_id(id)).find(Boolean)
    model?.setv(columns.length ? {data} : Object.fromEntries(values), {sync: false})
  }
}

export function render({model, el}) {
  el.style.display = "none"
  const answer = () => requestAnimationFrame(() => model.send_msg({painted: model.picture}))
  model.on("changes", () => { if (model.changes.length) change(model.changes) })
  model.on("picture", answer)
  answer()
}
