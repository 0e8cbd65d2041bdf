// A strip of cards, one per line of the figures below it: what it is, its number, and a switch for the line.
// A click hides or shows a line, a double click or the key S shows it alone, and once more those that were shown before.
// What is hidden is the server's to say: the strip asks for it by message and shows it at once. What the server sends counts
// once it has heard the last click, so that neither undoes the other.

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

  let hidden = model.hidden_lines
  let before = hidden  // the click: a double click is about what stood there before its first one
  let among = []  // what is hidden again once a line is no longer alone
  let asked = model.last_arrival

  const hide = (names) => {
    hidden = names
    mark()
    asked += 1
    model.send_msg({hidden: names, number: asked})
  }

  const toggle = (name) => {
    before = hidden
    const others = hidden.filter((it) => it !== name)
    hide(others.length < hidden.length ? others : [...others, name])
  }

  const isAlone = (name, was) => model.items.every((item) => was.includes(item.name) !== (item.name === name))
  const solo = (name, was) => {
    if (isAlone(name, was)) return hide(among)
    if (!model.items.some((item) => isAlone(item.name, was))) among = was
    const cards = model.items.map((item) => item.name)
    hide([...was.filter((it) => !cards.includes(it)), ...cards.filter((it) => it !== name)])  // a line without a card stays hidden
  }

  const cardOf = (item) => {
    const card = document.createElement("button")
    card.type = "button"
    card.className = hidden.includes(item.name) ? "card minor" : "card"  // until it is drawn again: a click moves no card
    card.dataset.name = item.name
    card.dataset.about = item.about ?? ""
    card.style.setProperty("--colour", item.colour)
    part(card, "line", "").innerHTML = line(item)
    part(card, "name", item.label)
    const value = part(card, "value", item.value)
    if (item.unit) {
      const unit = document.createElement("small")
      unit.textContent = ` ${item.unit}`
      value.append(unit)
    }
    for (const [letter, number, change] of item.compared ?? []) {
      const row = part(card, "compared", "")
      for (const [name, text] of [["b", letter], ["span", number], ["small", change]]) {
        row.append(Object.assign(document.createElement(name), {textContent: text}))
      }
    }
    part(card, "note", item.note)
    // Its line is there before it comes, so that nothing moves then.
    if (item.range !== undefined) part(card, "note", item.range).title = "where the mean error over seeds lies, at 95 % confidence"
    return card
  }

  const nameAt = (event) => event.target.closest(".card")?.dataset.name
  strip.onclick = (event) => {
    const name = nameAt(event)
    if (name && event.detail < 2) toggle(name)  // the second one of a double click does not count
  }
  strip.ondblclick = (event) => {
    const name = nameAt(event)
    if (name) solo(name, before)
  }
  strip.onkeydown = (event) => {
    const name = nameAt(event)
    if (name && event.key.toLowerCase() === "s" && !event.ctrlKey && !event.metaKey && !event.altKey) solo(name, hidden)
  }

  const mark = (cards = [...strip.children]) => {
    for (const card of cards) {
      const shown = !hidden.includes(card.dataset.name)
      const label = card.querySelector(".name").textContent
      card.setAttribute("aria-pressed", shown)
      card.title = `${card.dataset.about ? `${card.dataset.about} ` : ""}${shown ? "Hide" : "Show"} ${label}; double click or S: ${label} alone`
    }
    const n = cards.filter((it) => !hidden.includes(it.dataset.name)).length
    count.textContent = n < cards.length ? `${n} of ${cards.length} lines shown` : ""
    all.disabled = n === cards.length
  }

  const draw = () => {
    const cards = model.items.map(cardOf)
    mark(cards)
    patch(strip, cards)
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
  const all = button("Show all", () => { hide([]); draw() })
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

  // What an observer is, of the card that is pointed at or has the focus.
  const about = document.createElement("span")
  about.className = "about"
  hint.append(about)
  const tell = (event) => { about.textContent = event.target.closest(".card")?.dataset.about ?? "" }
  strip.onpointerover = tell
  strip.addEventListener("focusin", tell)
  strip.onpointerleave = () => { about.textContent = "" }

  model.on("items", draw)
  const follow = () => {
    if (asked !== model.last_arrival) return  // another click is on its way
    const own = hidden.join() === model.hidden_lines.join()
    hidden = model.hidden_lines
    if (own) mark()
    else draw()
  }
  model.on("hidden_lines", follow)
  model.on("last_arrival", follow)
  draw()
}
