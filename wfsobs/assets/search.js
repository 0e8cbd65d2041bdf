// A box that finds settings by their name, their meaning or their path; choosing one opens its topic and goes to it.

const MOST = 8 // of what is found
const SETTLED = 20 // frames in which a topic opens and moves what is in it

export function render({model, el}) {
  el.innerHTML = `<input type="search" placeholder="Find a setting" autocomplete="off" spellcheck="false" role="combobox"
    aria-label="Find a setting" aria-expanded="false" aria-controls="found" aria-autocomplete="list">
    <div id="found" role="listbox" aria-label="Settings found" hidden></div><div class="said" role="status"></div>`
  const [box, list, said] = el.children
  let at = 0, found = []

  const mark = () => {
    for (const [i, item] of [...list.children].entries()) item.setAttribute("aria-selected", i === at)
    if (found.length) box.setAttribute("aria-activedescendant", `found-${at}`)
    else box.removeAttribute("aria-activedescendant")
  }

  const show = () => {
    const words = box.value.toLowerCase().split(/\s+/).filter(Boolean)
    found = words.length ? ranked(model.items, words).slice(0, MOST) : []
    at = 0
    list.replaceChildren(...found.map((item, i) => {
      const row = Object.assign(document.createElement("div"), {id: `found-${i}`, role: "option", textContent: item.label})
      const topic = item.topic + (item.unused ? `: ${item.unused}` : "")
      row.append(Object.assign(document.createElement("small"), {textContent: topic}))
      row.onpointerdown = (event) => { event.preventDefault(); choose(item) }
      return row
    }))
    list.hidden = !found.length
    box.setAttribute("aria-expanded", found.length > 0)
    said.textContent = words.length && model.items.length && !found.length ? "No setting of that name" : ""
    mark()
  }

  const choose = (item) => {
    box.value = ""
    show()
    model.send_msg({path: item.path})
    go(item.path)
  }

  box.onfocus = () => model.send_msg({open: true})
  box.oninput = show
  box.onblur = () => { list.hidden = true; box.setAttribute("aria-expanded", "false") }
  box.onkeydown = (event) => {
    const step = {ArrowDown: 1, ArrowUp: -1}[event.key]
    if (step && found.length) {
      event.preventDefault()
      at = (at + step + found.length) % found.length
      mark()
    } else if (event.key === "Enter" && found.length) {
      event.preventDefault()
      choose(found[at])
    } else if (event.key === "Escape") {
      box.value = ""
      show()
    }
  }
  model.on("items", show)
  offerSweep(model, el)
}

// Those in which every word stands, first in whose name they do.
function ranked(items, words) {
  const rank = (item) => {
    const name = item.label.toLowerCase()
    const text = `${name} ${item.topic.toLowerCase()} ${item.path} ${item.doc.toLowerCase()}`
    if (!words.every((word) => text.includes(word))) return 0
    return name.startsWith(words[0]) ? 4 : words.every((word) => name.includes(word)) ? 3 : words.every((word) => item.path.includes(word)) ? 2 : 1
  }
  return items.map((item) => [rank(item), item]).filter(([r]) => r > 0).sort((a, b) => b[0] - a[0]).map(([, item]) => item)
}

// Give a setting the focus, as soon as its topic has opened, unless the visitor has gone on to something else by then.
function go(path) {
  const over = new AbortController()
  for (const act of ["pointerdown", "keydown"]) document.addEventListener(act, () => over.abort(), {capture: true, signal: over.signal})
  let tries = 600, still = 0
  const look = () => {
    if (over.signal.aborted) return
    const view = [...Bokeh.index.query((it) => it.model.tags?.includes(TAG + path))].find((it) => it.el.getBoundingClientRect().height > 0)
    const root = view?.el.shadowRoot
    const control = root?.querySelector("input, [role=combobox], select, button")
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
