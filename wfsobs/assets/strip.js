// A table of the lines of the figures below it, a row each: what it is, its error and what that is made of, and a switch for the
// line. A click hides or shows a line, a double click or the key S shows it alone, and once more those that were shown before.
// What is hidden is the server's to say: the table asks for it by message and shows it at once. What the server sends counts
// once it has heard the last click, so that neither undoes the other.

export function render({model, el}) {
  const strip = document.createElement("div")
  strip.className = "strip"
  const hint = document.createElement("div")
  hint.className = "hint"
  el.append(strip, hint)

  const make = (parent, name, text = "", title = "") => {
    const it = Object.assign(document.createElement("span"), {className: name, textContent: text})
    if (title) it.title = title
    parent.append(it)
    return it
  }

  const button = (parent, text, act) => {
    const it = Object.assign(document.createElement("button"), {type: "button", textContent: text, onclick: act})
    parent.append(it)
    return it
  }

  let hidden = model.hidden_lines
  let before = hidden  // the click: a double click is about what stood there before its first one
  let among = []  // what is hidden again once a line is no longer alone
  let asked = model.last_arrival
  let open = false  // whether there are rows of all, or of the main ones and those whose lines are shown

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
    const names = model.items.map((item) => item.name)
    hide([...was.filter((it) => !names.includes(it)), ...names.filter((it) => it !== name)])  // a line without a row stays hidden
  }

  const isMinor = (item) => !open && item.main === false && (hidden.includes(item.name) || item.value === "–")

  const barOf = (row, item, longest) => {
    const bar = make(row, "bar")
    if (!item.parts?.length) return
    bar.setAttribute("role", "img")
    bar.setAttribute("aria-label", item.parts.map(([, , text]) => text).join(", "))
    const sum = make(bar, "sum")
    sum.style.width = `${(100 * item.size) / longest}%`
    for (const [colour, share, text] of item.parts) {
      if (share > 0) make(sum, "", "", text).style.cssText = `flex: ${share} 0 0; background: ${colour}`
    }
    if (item.limit) make(bar, "limit").style.left = `${(100 * item.limit) / longest}%`
  }

  const rowOf = (item, longest) => {
    const row = document.createElement("button")
    row.type = "button"
    row.className = isMinor(item) ? "card minor" : "card"  // until it is drawn again: a click moves no row
    row.dataset.name = item.name
    row.dataset.about = item.about ?? ""
    make(row, "line").innerHTML =
      `<svg width="26" height="8" aria-hidden="true"><line x1="0" y1="4" x2="26" y2="4" stroke="${item.colour}"` +
      ` stroke-width="2.5" stroke-dasharray="${item.dash.join(" ")}"/></svg>`
    make(row, "name", item.label)
    const number = make(row, "number")
    make(number, "value", [item.value, item.unit].filter((it) => it).join(" "))
    if (item.half) make(number, "half", ` ± ${item.half}`, item.meaning)
    make(row, "note", item.note)
    for (const [, was, change] of item.compared ?? []) make(row, "compared", `${was} `).append(make(row, "small", change))
    make(row, "change", item.change)
    barOf(row, item, longest)
    return row
  }

  const headOf = () => {
    const head = document.createElement("div")
    head.className = "heads"
    const letters = (model.items[0]?.compared ?? []).map(([letter]) => letter)
    for (const text of ["", "", model.heads.value, model.heads.note, ...letters, model.heads.change, model.heads.bar]) {
      const cell = make(head, "", model.terms[text] ? "" : text)
      if (model.terms[text]) {
        const it = button(cell, text)
        it.className = "term"
        it.popoverTargetElement = make(cell, "definition", model.terms[text])
        Object.assign(it.popoverTargetElement, {popover: "auto", role: "note"})
      }
    }
    return head
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

  const mark = (rows = strip.querySelectorAll(".card")) => {
    for (const row of rows) {
      const shown = !hidden.includes(row.dataset.name)
      const label = row.querySelector(".name").textContent
      row.setAttribute("aria-pressed", shown)
      row.title = `${row.dataset.about} ${shown ? "Hide" : "Show"} ${label}; double click or S: ${label} alone`.trim()
    }
  }

  const draw = () => {
    const longest = Math.max(...model.items.filter((it) => !isMinor(it)).map((it) => it.size ?? 0))
    const rows = model.items.map((item) => rowOf(item, longest))
    mark(rows)
    strip.style.setProperty("--compared", `repeat(${1 + (model.items[0]?.compared ?? []).length}, max-content)`)
    patch(strip, Object.keys(model.heads).length ? [headOf(), ...rows] : rows)
    all.textContent = `All ${model.items.filter((it) => it.name !== "truth").length} ${model.kind}`
    patch(legend, model.legend.map(([colour, text]) => {
      const it = make(new DocumentFragment(), "key", text)
      it.style.setProperty("--colour", colour)
      return it
    }))
  }

  const turn = (to) => {
    open = to
    all.hidden = open
    lines.hidden = main.hidden = !open
    model.send_msg(open ? {all: true} : {main: true})
    draw()
  }
  const all = button(hint, "", () => { turn(true); main.focus() })
  const main = button(hint, `Main ${model.kind}`, () => { turn(false); all.focus() })
  const lines = button(hint, "Show all lines", () => hide([]))
  lines.hidden = main.hidden = true
  const below = make(hint, "below")
  const legend = make(below, "legend"), about = make(below, "about")

  // What an observer is, of the row that is pointed at or has the focus, in place of the legend.
  const tell = (event) => { about.textContent = event.target.closest(".card")?.dataset.about ?? "" }
  strip.onpointerover = tell
  strip.addEventListener("focusin", tell)
  strip.onpointerleave = () => { about.textContent = "" }
  strip.addEventListener("focusout", strip.onpointerleave)

  for (const name of ["items", "heads", "legend"]) model.on(name, draw)
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
