// The menus of files and of sharing, the button of the history, and what there is to say about them. It also keeps the address in
// step with the settings, and hears the keys for undo and redo.

const SAID_MS = 6_000 // for which something that was done is told

function tag(name, parent, properties = {}, attributes = {}) {
  const it = Object.assign(document.createElement(name), properties)
  for (const [key, value] of Object.entries(attributes)) it.setAttribute(key, value)
  parent.append(it)
  return it
}

function save(name, blob) {
  const url = URL.createObjectURL(blob)
  const link = document.createElement("a")
  Object.assign(link, {href: url, download: name})
  link.click()
  setTimeout(() => URL.revokeObjectURL(url), 10_000)
}

// ------------------------------------------------------------------ menus

function menu(bar, label, items) {
  const button = tag("button", bar, {type: "button", textContent: label},
                     {"aria-haspopup": "menu", "aria-expanded": "false", "aria-label": label})
  const list = tag("div", bar, {className: "menu", popover: "auto"}, {role: "menu", "aria-label": label})
  button.popoverTargetElement = list
  list.addEventListener("beforetoggle", (event) => {
    button.setAttribute("aria-expanded", event.newState === "open")
    if (event.newState === "open") {
      list.replaceChildren()
      for (const [text, act] of items()) {
        const item = tag("button", list, {type: "button", textContent: text, tabIndex: -1}, {role: "menuitem"})
        item.onclick = () => { list.hidePopover(); button.focus(); act() }
      }
    }
  })
  list.addEventListener("toggle", (event) => {
    if (event.newState !== "open") return
    const box = button.getBoundingClientRect()
    list.style.top = `${Math.min(box.bottom + 4, Math.max(window.innerHeight - list.offsetHeight - 8, 8))}px`
    list.style.left = `${Math.max(8, Math.min(box.left, window.innerWidth - list.offsetWidth - 8))}px`
    list.firstElementChild?.focus()
  })
  list.addEventListener("keydown", (event) => {
    if (event.key === "Escape") {
      event.preventDefault()
      list.hidePopover()
      button.focus()
    }
    move(event, [...list.children], list.getRootNode().activeElement)
  })
}

function move(event, items, focused) {
  const at = items.indexOf(focused)
  const to = {ArrowDown: at + 1, ArrowUp: at - 1 + items.length, Home: 0, End: items.length - 1}[event.key]
  if (to === undefined) return
  event.preventDefault()
  items[to % items.length]?.focus()
}

// ------------------------------------------------------------------ figures

async function saveFigure(name, view, kind, labels, say) {
  const blob = await exported(view, kind, labels)
  save(`${name.toLowerCase().replaceAll(/[^a-z0-9]+/g, "-")}.${kind}`, blob)
  say(`Saved ${name} as ${kind.toUpperCase()}.`)
}

// ------------------------------------------------------------------ the row

// What was done, in one line: in words of the browser, or of the server, which is told when they have been there for long enough.
function speaker(line, model) {
  let over
  const say = (text) => {
    line.textContent = text
    clearTimeout(over)
    if (text && !text.endsWith("…")) over = setTimeout(() => {
      line.textContent = ""
      if (text === model.message) model.send_msg({action: "read", text})
    }, SAID_MS)
  }
  model.on("message", () => say(model.message))
  say(model.message)
  return say
}

function isText(target) {
  const kind = target?.type ?? ""
  return target?.isContentEditable || target?.tagName === "TEXTAREA" ||
    (target?.tagName === "INPUT" && !["range", "checkbox", "radio", "button", "file"].includes(kind))
}

function keys(model) {
  const pressed = (event) => {
    const at = event.composedPath()[0]
    if (event.altKey || isText(at)) return
    if (!(event.ctrlKey || event.metaKey)) {
      if (event.key.toLowerCase() === "h" && !at.matches?.("[role=option], [role=combobox], [role=menuitem]")) model.send_msg({action: "history"})
      return
    }
    const key = event.key.toLowerCase()
    const action = key === "z" ? (event.shiftKey ? "redo" : "undo") : key === "y" ? "redo" : ""
    if (action) {
      event.preventDefault()
      model.send_msg({action})
    }
  }
  document.addEventListener("keydown", pressed)
  model.on("remove", () => document.removeEventListener("keydown", pressed))
}

function textBox(el, say) {
  const box = tag("div", el, {className: "text", hidden: true})
  const label = tag("label", box, {textContent: "Copy this by hand"})
  const area = tag("textarea", label, {readOnly: true})
  tag("button", box, {type: "button", textContent: "Close"}).onclick = () => { box.hidden = true }
  return async (text, what) => {
    try {
      await navigator.clipboard.writeText(text)
      box.hidden = true
      say(`Copied the ${what}.`)
    } catch {
      area.value = text
      box.hidden = false
      area.select()
      say("The browser does not let this page copy.")
    }
  }
}

// Opens a file as if it had been dropped on the page.
function opener(bar) {
  const input = tag("input", bar, {type: "file", accept: ".toml,.wfsobs-session", hidden: true}, {"aria-label": "Scenario file"})
  input.onchange = () => {
    if (input.files[0]) document.dispatchEvent(new CustomEvent("wfsobs:file", {detail: input.files[0]}))
    input.value = ""
  }
  return () => input.click()
}

// What was refused; the function that takes it away.
function noteBox(el, model, say) {
  const box = tag("div", el, {className: "notes", hidden: true})
  const lines = tag("div", box, {}, {role: "alert"})
  const dismiss = () => {
    box.hidden = true
    model.send_msg({action: "dismiss"})
  }
  tag("button", box, {type: "button", textContent: "Dismiss"}).onclick = dismiss
  const draw = () => {
    lines.replaceChildren()
    model.notes.forEach((note) => tag("p", lines, {textContent: note}))
    box.hidden = model.notes.length === 0
    if (!box.hidden) say(model.message)
  }
  model.on("notes", draw)
  draw()
  return dismiss
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

export function render({model, view, el}) {
  const bar = tag("div", el, {className: "bar"})
  const here = () => {
    const query = [model.query, model.view].filter(Boolean).join("&")
    return location.origin + location.pathname + (query ? `?${query}` : "")
  }
  const copyLink = () => model.has_link ? copy(here(), model.record ? `link, which is without ${model.record}` : "link") : model.send_msg({action: "unlinked"})
  const ask = (message, what = "Preparing the file …") => () => {
    dismiss()
    say(what)
    model.send_msg(message)
  }
  const open = opener(bar)
  menu(bar, "File", () => [
    ["Load data …", () => document.dispatchEvent(new Event("wfsobs:load"))],
    ["Open scenario or session …", open],
    ["Save scenario as TOML", ask({action: "toml"})],
    ["Save session", ask({action: "session"})],
    ...model.saves.map((name) => [`Save ${name}`, ask({action: "page", name})]),
    ...(model.ready ? [["Save data as CSV", ask({action: "csv"})], ["Save data as NPZ", ask({action: "npz"})]] : []),
    ...(model.ready && !model.reporting ? [["Save report", ask({action: "report"}, "Making the report …")]] : []),
    ...figures().flatMap(([name, view]) =>
      KINDS.map((kind) => [`Save ${name} as ${kind.toUpperCase()}`, () => saveFigure(name, view, kind, model.labels, say)])),
  ])
  menu(bar, "Share", () => [
    ["Copy link", copyLink],
    ["Copy as command line", () => copy(model.command, "command line")],
    ["Copy as Python", () => copy(model.python, "Python")],
  ])
  tag("button", bar, {type: "button", textContent: "History", title: "Every result of this session, to compare, restore and save (H)"},
      {"aria-haspopup": "dialog"}).onclick = () => model.send_msg({action: "history"})
  const say = speaker(tag("span", bar, {className: "said"}, {role: "status"}), model)
  const copy = textBox(el, say)
  const dismiss = noteBox(el, model, say)
  keys(model)

  const address = () => history.replaceState(history.state, "", here() + location.hash)
  model.on("query", address)
  travel(model, view.model.document, address, () => history.pushState(null, "", here()))
  if (known.has(view.model.document)) address()
  known.add(view.model.document)
  model.on("msg:custom", (event) => {
    const {name, kind, content} = event.data ?? event
    save(name, new Blob([Uint8Array.from(atob(content), (c) => c.charCodeAt(0))], {type: kind}))
    say(`Saved ${name}.`)
  })
}
