// The menus of files and of sharing, the button of the history, and what there is to say about them. It keeps the address in step
// with the settings, and hears the keys for undo and redo.

const SAID_MS = 6_000 // for which something that was done is told

export function render({model, view, el}) {
  el.innerHTML = `<div class="bar"></div><span class="said" role="status"></span>
    <label class="text" popover>Copy this by hand<textarea readonly></textarea></label>`
  const [bar, said, text] = el.children

  // What was done, in words of the browser, or of the server, which is told when they have been read.
  let over
  const say = (words) => {
    said.textContent = words
    clearTimeout(over)
    if (words && !words.endsWith("…")) over = setTimeout(() => {
      said.textContent = ""
      if (words === model.message) model.send_msg({action: "read", text: words})
    }, SAID_MS)
  }
  model.on("message", () => say(model.message))
  model.on("notes", () => { if (model.notes.length) say(model.message) })
  say(model.message)
  model.on("msg:custom", (event) => {
    const {name, kind, content} = event.data ?? event
    save(name, new Blob([content], {type: kind}))
    say(`Saved ${name}.`)
  })

  const here = () => {
    const query = [model.query, model.view].filter(Boolean).join("&")
    return location.origin + location.pathname + (query ? `?${query}` : "")
  }
  const copy = async (what) => {
    if (what === "link" && !model.has_link) return model.send_msg({action: "unlinked"})
    const link = model.record ? `link, which is without ${model.record}` : "link"
    const content = what === "link" ? here() : model[what]
    try {
      await navigator.clipboard.writeText(content)
      say(`Copied the ${{link, command: "command line", python: "Python"}[what]}.`)
    } catch {
      text.showPopover()
      Object.assign(text.lastElementChild, {value: content}).select()
      say("The browser does not let this page copy.")
    }
  }

  const saveFigure = async (name, view) => {
    save(`${name.toLowerCase().replaceAll(/[^a-z0-9]+/g, "-")}.svg`, await exported(view, model.labels))
    say(`Saved ${name}.`)
  }
  const itemOf = ([name, view]) => Object.assign(document.createElement("button"), {
    type: "button", className: "figure", textContent: `Save ${name} as SVG`, act: () => saveFigure(name, view)})

  showMarkup(bar, model)
  bar.addEventListener("beforetoggle", ({target, newState}) => {
    if (target.matches(":focus-within")) target.previousElementSibling.focus()  // the browser knows the host of the shadow alone
    for (const it of target.querySelectorAll(".figure")) it.remove()
    if (newState === "open" && target.id === "File") target.append(...figures().map(itemOf))
  }, true)
  bar.addEventListener("click", ({target}) => {
    if (target.dataset.do === "dismiss") target.parentElement.hidden = true // at once, also where the server does not hear it
    if (!target.matches(".menu > button")) return
    target.parentElement.hidePopover()
    const {event, copy: what, do: does} = target.dataset
    if (event) document.dispatchEvent(new Event(event))
    if (what) copy(what)
    if (does) say(does === "report" ? "Making the report …" : "Preparing the file …")
    target.act?.()
  })

  const doc = view.model.document
  const address = () => history.replaceState(history.state, "", here() + location.hash)
  model.on("query", address)
  travel(model, doc, address, () => history.pushState(null, "", here()))
  if (known.has(doc)) address()
  known.add(doc)
  listen(model, {keydown: (event) => keyPressed(event, model)})
}

function keyPressed(event, model) {
  const at = event.composedPath()[0], key = event.key.toLowerCase()
  if (keyAlone(event) && key === "h" && !at.matches?.("[role=option], [role=combobox]")) model.send_msg({action: "history"})
  if (event.altKey || !(event.ctrlKey || event.metaKey) || at.matches?.(TEXT)) return
  const action = {z: event.shiftKey ? "redo" : "undo", y: "redo"}[key]
  if (!action) return
  event.preventDefault()
  model.send_msg({action})
}

// Parts of a view that make another one, to which the browser's Back returns.
const OWN = ["view.page", "view.mode", "view.unit", "view.show", "view.spectrum"]

// Keep the address in step with the view, and the view with where Back and Forward lead.
function travel(model, document, replace, push) {
  const own = (query) => JSON.stringify(OWN.map((key) => new URLSearchParams(query).get(key)))
  let travelling = false
  model.on("view", () => {
    if (!travelling && own(model.view) !== own(location.search)) push()
    else replace()
    if (own(model.view) === own(location.search)) travelling = false
  })
  const went = () => {
    travelling = own(model.view) !== own(location.search)
    model.send_msg({action: "view", query: location.search})
  }
  window.addEventListener("popstate", went)
  const fetched = new URL(performance.getEntriesByType("navigation")[0].name).search
  if (!known.has(document) && fetched !== location.search) went()  // Back was pressed before this was here
  model.on("remove", () => window.removeEventListener("popstate", went))
}

const known = new WeakSet() // documents; one may be drawn anew after a connection was lost
