// A strip of cards, one per line of the figures below it: what it is, its number, and a switch for the line.

export function render({model, el}) {
  const strip = document.createElement("div")
  strip.className = "strip"
  el.append(strip)

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

  const draw = () => {
    const focused = el.getRootNode().activeElement?.dataset?.name
    strip.replaceChildren(...model.items.map((item) => {
      const shown = !model.hidden.includes(item.name)
      const card = document.createElement("button")
      card.type = "button"
      card.className = "card"
      card.dataset.name = item.name
      card.style.setProperty("--colour", item.colour)
      card.setAttribute("aria-pressed", shown)
      card.title = shown ? `Hide ${item.label}` : `Show ${item.label}`
      part(card, "line", "").innerHTML = line(item)
      part(card, "name", item.label)
      const value = part(card, "value", item.value)
      if (item.unit) {
        const unit = document.createElement("small")
        unit.textContent = ` ${item.unit}`
        value.append(unit)
      }
      part(card, "note", item.note)
      card.onclick = () => {
        const hidden = model.hidden.filter((name) => name !== item.name)
        model.hidden = shown ? [...hidden, item.name] : hidden
      }
      return card
    }))
    if (focused) {
      strip.querySelector(`[data-name="${focused}"]`)?.focus()
    }
  }

  model.on("items", draw)
  model.on("hidden", draw)
  draw()
}
