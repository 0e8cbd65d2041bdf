// Answers each picture once it has been painted; the next one waits for that, so that none are kept for a page that sleeps.

// What of a figure that is not to be seen waits for it to be scrolled to, a second at most.
const PATIENCE = 1_000
const places = new Map() // id of a figure -> its element, whether it is to be seen, when it was changed, and what waits

function placeOf(id) {
  let place = places.get(id)
  if (place?.el.isConnected) return place
  const [view] = Bokeh.index.query((it) => it.model.id === id)
  place = view && {el: view.el, seen: true, last: 0, waiting: new Map()}
  if (!view) return null
  places.set(id, place)
  new IntersectionObserver((entries) => {
    place.seen = entries.at(-1).isIntersecting
    if (place.seen) make(place)
  }, {rootMargin: "100px"}).observe(view.el)
  return place
}

function make(place) {
  for (const act of place.waiting.values()) act()
  place.waiting.clear()
  place.last = performance.now()
}

// Make the changes of a picture: for each model its figure, its id, the columns and their length, or properties and their values.
// They come from the server, which is not told of them.
function change([steps, numbers]) {
  const all = new Float32Array(numbers.buffer, numbers.byteOffset, numbers.length)
  const changed = new Set()
  let at = 0
  for (const [figure, id, columns, n, values] of steps) {
    const data = Object.fromEntries(columns.map((name) => [name, all.slice(at, (at += n))]))
    const model = Bokeh.documents.map((it) => it.get_model_by_id(id)).find(Boolean)
    const act = () => model?.setv(columns.length ? {data} : Object.fromEntries(values), {sync: false})
    const place = placeOf(figure)
    if (!place) act()
    else {
      place.waiting.set(id, act)
      changed.add(place)
    }
  }
  for (const place of changed) if (place.seen || performance.now() - place.last > PATIENCE) make(place)
}

let picture = 0 // the last one, also where this is drawn anew

export function render({model, el}) {
  el.style.display = "none"
  const answer = () => requestAnimationFrame(() => model.send_msg({painted: picture}))
  model.on("msg:custom", (event) => {
    const sent = event.data ?? event
    if (sent.changes) return change(sent.changes)
    picture = sent.picture
    answer()
  })
  answer()
}
