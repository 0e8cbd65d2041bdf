// The menus of files and of sharing, the button of the history, and what there is to say about them. It also keeps the address in
// step with the settings, and hears the keys for undo and redo.

const SAID_MS = 6_000 // for which something that was done is told

export function render({model, view, el}) {
  el.innerHTML = `<div class="bar"></div><span class="said" role="status"></span>
    <div class="text" hidden><label>Copy this by hand<textarea readonly></textarea></label><button type="button">Close</button></div>
    <div class="notes" hidden><div role="alert"></div><button type="button">Dismiss</button></div>`
  const [bar, said, text, notes] = el.children

  // What was done, in one line: in words of the browser, or of the server, which is told when they have been there for long enough.
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
  say(model.message)
  takeFiles(model, (name) => say(`Saved ${name}.`))

  // What was refused.
  const note = () => {
    notes.hidden = model.notes.length === 0
    notes.firstChild.replaceChildren(...model.notes.map((it) => Object.assign(document.createElement("p"), {textContent: it})))
    if (!notes.hidden) say(model.message)
  }
  const dismiss = () => { notes.hidden = true; model.send_msg({action: "dismiss"}) }
  notes.querySelector("button").onclick = dismiss
  model.on("notes", note)
  note()

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
      text.hidden = true
      say(`Copied the ${{link, command: "command line", python: "Python"}[what]}.`)
    } catch {
      text.hidden = false
      Object.assign(text.querySelector("textarea"), {value: content}).select()
      say("The browser does not let this page copy.")
    }
  }
  text.querySelector("button").onclick = () => { text.hidden = true }

  const saveFigure = async (name, view, kind) => {
    save(`${name.toLowerCase().replaceAll(/[^a-z0-9]+/g, "-")}.${kind}`, await exported(view, kind, model.labels))
    say(`Saved ${name} as ${kind.toUpperCase()}.`)
  }
  const itemOf = ([name, view], kind) => {
    const it = Object.assign(document.createElement("button"), {type: "button", role: "menuitem", tabIndex: -1, className: "figure"})
    return Object.assign(it, {textContent: `Save ${name} as ${kind.toUpperCase()}`, act: () => saveFigure(name, view, kind)})
  }

  const draw = () => setMarkup(bar, model.html)
  model.on("html", draw)
  draw()
  tellActions(bar, model)
  bar.addEventListener("beforetoggle", ({target, newState}) => {
    target.previousElementSibling.setAttribute("aria-expanded", newState === "open")
    for (const it of target.querySelectorAll(".figure")) it.remove()
    if (newState === "open" && target.id === "File") target.append(...figures().flatMap((it) => KINDS.map((kind) => itemOf(it, kind))))
  }, true)
  bar.addEventListener("toggle", ({target, newState}) => { if (newState === "open") target.firstElementChild.focus() }, true)
  const leave = (menu) => { menu.hidePopover(); menu.previousElementSibling.focus() }
  bar.addEventListener("keydown", (event) => {
    const items = [...event.target.closest(".menu")?.children ?? []], at = items.indexOf(event.target), n = items.length
    const to = {ArrowDown: at + 1, ArrowUp: at - 1 + n, Home: 0, End: n - 1}[event.key]
    if (!n || (to === undefined && event.key !== "Escape")) return
    event.preventDefault()
    if (event.key === "Escape") leave(event.target.parentElement)
    else items[to % n].focus()
  })
  bar.addEventListener("click", ({target}) => {
    if (!target.matches("[role=menuitem]")) return
    leave(target.parentElement)
    const {event, copy: what, do: does} = target.dataset
    if (event) document.dispatchEvent(new Event(event))
    if (what) copy(what)
    if (does) { notes.hidden = true; say(does === "report" ? "Making the report …" : "Preparing the file …") }
    target.act?.()
  })

  const doc = view.model.document
  const address = () => history.replaceState(history.state, "", here() + location.hash)
  model.on("query", address)
  travel(model, doc, address, () => history.pushState(null, "", here()))
  if (known.has(doc)) address()
  known.add(doc)
  const pressed = (event) => keyPressed(event, model)
  document.addEventListener("keydown", pressed)
  model.on("remove", () => document.removeEventListener("keydown", pressed))
}

const TEXT = "[contenteditable], textarea, input:not([type=range], [type=checkbox], [type=radio], [type=button], [type=file])"

function keyPressed(event, model) {
  const at = event.composedPath()[0], key = event.key.toLowerCase()
  if (event.altKey || at.matches?.(TEXT)) return
  if (!(event.ctrlKey || event.metaKey)) {
    if (key === "h" && !at.matches?.("[role=option], [role=combobox], [role=menuitem]")) model.send_msg({action: "history"})
    return
  }
  const action = key === "z" ? (event.shiftKey ? "redo" : "undo") : key === "y" ? "redo" : ""
  if (!action) return
  event.preventDefault()
  model.send_msg({action})
}

// Parts of a view that are one of their own, to which the browser's Back returns; the others belong to the one they are changed in.
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
