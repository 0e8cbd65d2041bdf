// A box that finds settings by name, topic or path, opens the topic and goes there.

const SETTLED = 20 // frames in which a topic opens and moves what is in it

export function render({model, el}) {
  el.innerHTML = `<input type="search" placeholder="Find a setting" autocomplete="off" spellcheck="false" list="found"
    aria-label="Find a setting"><datalist id="found"></datalist>`
  const [box, list] = el.children
  const choose = (item) => {
    box.value = ""
    model.send_msg({path: item.path})
    go(item.path)
  }
  // The one of a name, or the first in which every word stands; those first whose names begin with them.
  const find = () => {
    const text = box.value.trim().toLowerCase(), words = text.split(/\s+/)
    const all = model.items.filter((it) => words.every((word) => `${it.name} ${it.path}`.toLowerCase().includes(word)))
    return all.find((it) => it.name.toLowerCase().startsWith(text)) ?? all[0]
  }

  let isEntered = false // before the settings have come, which they do when the box is first used
  const enter = () => {
    isEntered = !model.items.length
    if (isEntered) return
    const found = find()
    if (found) return choose(found)
    box.setCustomValidity("No setting of that name")
    box.reportValidity()
  }
  const fill = () => {
    list.replaceChildren(...model.items.map(({name, path}) => new Option(path, name)))
    if (isEntered) enter()
  }
  box.onfocus = () => model.send_msg({open: true})
  box.oninput = () => {
    isEntered = false
    box.setCustomValidity("")
    const chosen = model.items.find(({name}) => name === box.value)
    if (chosen) choose(chosen)
  }
  box.onkeydown = ({key}) => { if (key === "Enter" && box.value.trim()) enter() }
  model.on("items", fill)
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
