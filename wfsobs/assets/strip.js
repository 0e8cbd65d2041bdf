// A strip of cards, one per line of the figures below it: what it is, its number, and a switch for the line.
// A click hides or shows a line, a double click or the key S shows it alone, and once more all of them.
// What is hidden is the server's to say: the strip asks for it by message and shows it at once, so that what the server
// sends while a click is on its way cannot leave the two apart.

export function render({model, el}) {
  const strip = document.createElement("div")
  strip.className = "strip"
  const hint = document.createElement("div")
  hint.className = "hint"
  el.append(strip, hint)

  const line = (item) =>
    `<svg width="26" height="8" aria-hidden="true"><line x1="0" y1="4" x2="26" y2="4" stroke="${item.colour}"` +
    ` stroke-width="2.5" stroke-dasharray="${item.dash.join(" ")}"/></svg>`

  const part = (card, name, text) => {
    const div = document.createElement("div")
    div.className = name
    div.textContent = text
    card.append(div)
    return div
  }

  let hidden = model.hidden
  let before = hidden  // the click: a double click is about what stood there before its first one

  const hide = (names) => {
    hidden = names
    mark()
    model.send_msg({hidden: names})
  }

  const toggle = (name) => {
    before = hidden
    const others = hidden.filter((it) => it !== name)
    hide(others.length < hidden.length ? others : [...others, name])
  }

  const solo = (name, among) => {
    const others = model.items.map((item) => item.name).filter((it) => it !== name)
    const alone = !among.includes(name) && others.every((it) => among.includes(it))
    hide(alone ? [] : others)
  }

  const cardOf = (item) => {
    const card = document.createElement("button")
    card.type = "button"
    card.className = "card"
    card.dataset.name = item.name
    card.style.setProperty("--colour", item.colour)
    part(card, "line", "").innerHTML = line(item)
    part(card, "name", item.label)
    const value = part(card, "value", item.value)
    if (item.unit) {
      const unit = document.createElement("small")
      unit.textContent = ` ${item.unit}`
      value.append(unit)
    }
    part(card, "note", item.note)
    if (item.range) part(card, "note", item.range).title = "where the mean error over seeds lies, at 95 % confidence"
    card.onclick = (event) => { if (event.detail < 2) toggle(item.name) }  // the second one of a double click does not count
    card.ondblclick = () => solo(item.name, before)
    card.onkeydown = (event) => {
      if (event.key.toLowerCase() === "s" && !event.ctrlKey && !event.metaKey && !event.altKey) solo(item.name, hidden)
    }
    return card
  }

  const mark = () => {
    for (const card of strip.children) {
      const shown = !hidden.includes(card.dataset.name)
      const label = card.querySelector(".name").textContent
      card.setAttribute("aria-pressed", shown)
      card.title = `${shown ? "Hide" : "Show"} ${label}; double click or S: ${label} alone`
    }
    const n = strip.children.length - [...strip.children].filter((it) => hidden.includes(it.dataset.name)).length
    count.textContent = n < strip.children.length ? `${n} of ${strip.children.length} lines shown` : ""
    all.disabled = n === strip.children.length
  }

  const draw = () => {
    const focused = el.getRootNode().activeElement?.dataset?.name
    strip.replaceChildren(...model.items.map(cardOf))
    mark()
    if (focused) {
      strip.querySelector(`[data-name="${focused}"]`)?.focus()
    }
  }

  const button = (text, act) => {
    const it = document.createElement("button")
    it.type = "button"
    it.textContent = text
    it.onclick = act
    hint.append(it)
    return it
  }
  const count = document.createElement("span")
  hint.append(count)
  const all = button("Show all", () => hide([]))
  if (model.main) button(model.main, () => model.send_msg({main: true}))

  for (const [word, meaning] of Object.entries(model.terms)) {
    const it = button(word)
    it.className = "term"
    const definition = document.createElement("span")
    Object.assign(definition, {className: "definition", popover: "auto", textContent: meaning})
    definition.setAttribute("role", "note")
    it.popoverTargetElement = definition
    hint.append(definition)
  }

  model.on("items", draw)
  model.on("hidden", () => {
    hidden = model.hidden
    mark()
  })
  draw()
}
