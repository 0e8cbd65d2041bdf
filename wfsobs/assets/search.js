// A box that finds settings by name, topic or path, opens the topic and goes there.

const SETTLED = 20 // frames in which a topic opens and moves what is in it

export function render({model, el}) {
  el.innerHTML = `<input type="search" placeholder="Find a setting" autocomplete="off" spellcheck="false" list="found"
    aria-label="Find a setting"><datalist id="found"></datalist>`
  const [box, list] = el.children
  const find = () => model.send_msg({find: box.value})
  const fill = () => list.replaceChildren(...model.items.map(({name, path}) => new Option(path, name)))
  box.onfocus = () => model.send_msg({open: true})
  box.oninput = () => {
    box.setCustomValidity("")
    if (model.items.some(({name}) => name === box.value)) find() // chosen from the list
  }
  box.onkeydown = ({key}) => { if (key === "Enter" && box.value.trim()) find() }
  model.on("items", fill)
  model.on("msg:custom", (event) => {
    const {path, text} = event.data ?? event
    if (text !== box.value) return // other words are in it meanwhile
    if (path) {
      box.value = ""
      return go(path)
    }
    box.setCustomValidity("No setting of that name")
    box.reportValidity()
  })
  fill()
  listen(model, {keydown: (event) => {
    if (keyAlone(event) !== "/") return
    event.preventDefault()
    box.focus()
  }})
}

// Give a setting the focus as soon as its topic has opened, unless the visitor has gone on by then.
function go(path) {
  const over = new AbortController()
  for (const act of ["pointerdown", "keydown"]) document.addEventListener(act, () => over.abort(), {capture: true, signal: over.signal})
  let tries = 600, still = 0
  const look = () => {
    if (over.signal.aborted) return
    const view = [...Bokeh.index.query((it) => it.model.tags?.includes(TAG + path))].find((it) => it.el.getBoundingClientRect().height > 0)
    const control = view?.el.shadowRoot?.querySelector("input, [role=combobox], select, button")
    const target = control?.matches(":disabled, [aria-disabled=true]") ? view.el : control // a grey one takes no focus itself
    const there = target?.matches(":focus")
    if (still && !there) return over.abort()
    if (target) {
      if (target === view.el) view.el.tabIndex = -1
      view.el.scrollIntoView({block: "center"})
      if (!there) target.focus()
      still += target.matches(":focus")
    }
    if (still > SETTLED || !tries--) over.abort()
    else requestAnimationFrame(look)
  }
  look()
}
