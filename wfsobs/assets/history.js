// The history: a sheet at the right edge with every result of the session. What it shows is the server's; it asks by messages.

export function render({model, el}) {
  const make = (name, parent, properties = {}, attributes = {}) => {
    const it = Object.assign(document.createElement(name), properties)
    for (const [key, value] of Object.entries(attributes)) it.setAttribute(key, value)
    parent?.append(it)
    return it
  }
  const button = (parent, text, properties = {}, attributes = {}) =>
    make("button", parent, {type: "button", textContent: text, ...properties}, attributes)

  const sheet = make("div", el, {className: "sheet", popover: "manual"}, {role: "dialog", "aria-label": "History"})
  const top = make("div", sheet, {className: "top"})
  make("h2", top, {textContent: "History"})
  button(top, "Close", {onclick: () => model.send_msg({action: "close"})})
  const bar = make("div", sheet, {className: "bar"})
  button(bar, "Save session", {onclick: () => model.send_msg({action: "save"})})
  const input = make("input", bar, {type: "file", accept: model.suffix, hidden: true}, {"aria-label": "Session file"})
  input.onchange = () => {
    if (input.files[0]) send(model, input.files[0])
    input.value = ""
  }
  button(bar, "Open session", {onclick: () => input.click()})
  const label = make("label", bar)
  const filter = make("input", label, {type: "checkbox"})
  label.append("Starred only")
  const said = make("div", sheet, {className: "said"})
  const line = make("span", said, {}, {role: "status"})
  const undo = button(said, "Undo delete", {onclick: () => model.send_msg({action: "undelete"})})
  const list = make("ol", sheet, {className: "list"}, {"aria-label": "Results, newest first"})

  const rowOf = (row) => {
    const li = make("li", null, {className: row.current ? "row current" : "row"}, {"data-key": row.key})
    const head = make("div", li, {className: "head"})
    button(head, row.star ? "★" : "☆", {className: "star"}, {"aria-pressed": row.star, "aria-label": `Star ${row.name}`, "data-do": "star"})
    make("input", head, {className: "name"}, {type: "text", value: row.name, title: row.name, maxlength: 200, "aria-label": "Name of the result"})
    make("div", li, {className: "facts", textContent: [when(row.time), row.what, ...row.current ? ["shown now"] : []].filter(Boolean).join(" · ")})
    if (row.scores) make("div", li, {className: "facts", textContent: row.scores})
    if (row.note) make("div", li, {className: "facts", textContent: row.note})
    const does = make("div", li, {className: "does"})
    const tick = make("label", does)
    make("input", tick, {}, {type: "checkbox", "data-do": "compare", "aria-label": `Compare ${row.name}`,
                             ...row.letter ? {checked: ""} : {}, ...row.letter || model.room ? {} : {disabled: ""}})
    make("span", tick, {textContent: row.letter ? `Compared as ${row.letter}` : "Compare"})
    button(does, "Restore", {}, {"data-do": "restore", "aria-label": `Restore ${row.name}`, ...row.restorable ? {} : {disabled: ""}})
    button(does, "Delete", {}, {"data-do": "delete", "aria-label": `Delete ${row.name}`})
    return li
  }

  const draw = () => {
    const rows = model.rows.filter((row) => row.star || !filter.checked)
    const typed = el.getRootNode().activeElement ?? list.getRootNode().activeElement
    patch(list, rows.map(rowOf))
    for (const li of list.children) {  // what was typed or ticked is no attribute
      const name = li.querySelector(".name"), tick = li.querySelector("[data-do=compare]")
      if (name !== typed || name.dataset.of !== li.dataset.key) name.value = name.getAttribute("value")
      name.dataset.of = li.dataset.key
      tick.checked = tick.hasAttribute("checked")
    }
    list.hidden = rows.length === 0
    empty.hidden = rows.length > 0
    empty.textContent = filter.checked ? "No result has a star." : "No result yet."
  }
  const empty = make("p", sheet, {className: "facts"})
  filter.onchange = draw

  const keyOf = (event) => event.target.closest("[data-key]")?.dataset.key
  const ask = (event, action, more = {}) => model.send_msg({action, key: keyOf(event), ...more})
  list.onclick = (event) => {
    const action = event.target.closest("[data-do]")?.dataset.do
    if (action === "compare") ask(event, action, {on: event.target.checked})
    else if (action) ask(event, action)
  }
  const rename = (event) => {
    const box = event.target
    if (box.matches(".name") && box.value !== box.getAttribute("value")) ask(event, "rename", {name: box.value})
  }
  list.addEventListener("change", rename)
  list.onkeydown = (event) => {
    if (!event.target.matches(".name")) return
    if (event.key === "Enter") event.target.blur()
    if (event.key === "Escape") { event.stopPropagation(); event.target.value = event.target.getAttribute("value") }
  }
  sheet.onkeydown = (event) => { if (event.key === "Escape") model.send_msg({action: "close"}) }

  let before = null // what had the focus
  const follow = () => {
    if (model.open === sheet.matches(":popover-open")) return
    if (model.open) {
      before = focused()
      draw()
      sheet.showPopover()
      top.querySelector("button").focus()
    } else {
      sheet.hidePopover()
      before?.focus()
    }
  }
  const paint = () => sheet.classList.toggle("dark", model.dark)
  const say = () => {
    line.textContent = model.message
    undo.hidden = !model.undo
  }
  model.on("open", follow)
  model.on("rows", draw)
  model.on("room", draw)
  model.on("dark", paint)
  model.on("message", say)
  model.on("undo", say)
  model.on("msg:custom", (event) => {
    const {name, kind, content} = event.data ?? event
    save(name, kind, content)
  })
  say()
  paint()
  draw()
  requestAnimationFrame(() => { if (sheet.isConnected) follow() })
}

function focused() {
  let it = document.activeElement
  while (it?.shadowRoot?.activeElement) it = it.shadowRoot.activeElement
  return it
}

function when(seconds) {
  const at = new Date(seconds * 1000), today = at.toDateString() === new Date().toDateString()
  return today ? at.toLocaleTimeString() : at.toLocaleString()
}
