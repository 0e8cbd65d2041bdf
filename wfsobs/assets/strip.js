// A table of the lines of the figures below it. A click hides or shows a line, a double click or the key S shows it alone, and once
// more those that were shown before. What the server sends counts once it has heard the last click, so that neither undoes the other.

export function render({model, el}) {
  let hidden = model.hidden_lines
  let before = hidden  // the first click of a double one
  let among = []  // what is hidden again once a line is no longer alone
  let asked = model.last_arrival
  let told = null  // whose row is pointed at or has the focus
  let open = false  // whether there are rows of all

  const rows = () => [...el.querySelectorAll(".card")]
  const nameAt = (target) => target.closest(".card")?.dataset.name

  const hide = (names) => {
    hidden = names
    mark()
    asked += 1
    model.send_msg({hidden: names, number: asked})
  }

  const toggle = (name) => {
    before = hidden
    hide(hidden.includes(name) ? hidden.filter((it) => it !== name) : [...hidden, name])
  }

  const solo = (name, was) => {
    const names = rows().map((it) => it.dataset.name)
    const isAlone = (name) => names.every((it) => was.includes(it) !== (it === name))
    if (isAlone(name)) return hide(among)
    if (!names.some(isAlone)) among = was
    hide([...was.filter((it) => !names.includes(it)), ...names.filter((it) => it !== name)])  // a line without a row stays hidden
  }

  const mark = () => {
    for (const row of rows()) {
      const isShown = !hidden.includes(row.dataset.name), label = row.querySelector(".name").textContent
      row.setAttribute("aria-pressed", isShown)
      row.title = `${row.dataset.about} ${isShown ? "Hide" : "Show"} ${label}; double click or S: ${label} alone`.trim()
    }
  }

  const draw = () => {
    patchHtml(el, model.html)
    el.classList.toggle("open", open)
    let longest = 0
    for (const row of rows()) {  // until they are drawn again: a click moves no row
      const isMinor = !open && "minor" in row.dataset && (hidden.includes(row.dataset.name) || "empty" in row.dataset)
      row.classList.toggle("minor", isMinor)
      if (!isMinor) longest = Math.max(longest, row.dataset.size)
    }
    el.style.setProperty("--longest", longest)
    mark()
    describe()
  }

  // What an observer is, in place of the legend.
  const describe = () => {
    const about = el.querySelector(".about")
    if (about) about.textContent = rows().find((it) => it.dataset.name === told)?.dataset.about ?? ""
  }

  const turn = (to) => {
    open = to
    model.send_msg(open ? {all: true} : {main: true})
    draw()
    el.querySelector(`[data-rows=${open ? "main" : "all"}]`).focus()
  }

  el.onclick = ({target, detail}) => {
    const of = target.closest("[data-rows]")?.dataset.rows, name = nameAt(target)
    if (of === "lines") hide([])
    else if (of) turn(of === "all")
    else if (name && detail < 2) toggle(name)  // the second one of a double click does not count
  }
  el.ondblclick = ({target}) => { if (nameAt(target)) solo(nameAt(target), before) }
  el.onkeydown = ({target, key, ctrlKey, metaKey, altKey}) => {
    if (nameAt(target) && key.toLowerCase() === "s" && !ctrlKey && !metaKey && !altKey) solo(nameAt(target), hidden)
  }

  const tell = ({target}) => {
    told = nameAt(target)
    describe()
  }
  for (const type of ["pointerover", "focusin", "focusout"]) el.addEventListener(type, tell)
  el.onpointerleave = () => tell({target: el})

  model.on("html", draw)
  const follow = () => {
    if (asked !== model.last_arrival) return  // another click is on its way
    const isOwn = hidden.join() === model.hidden_lines.join()
    hidden = model.hidden_lines
    if (isOwn) mark()
    else draw()
  }
  model.on(["hidden_lines", "last_arrival"], follow)
  draw()
}
