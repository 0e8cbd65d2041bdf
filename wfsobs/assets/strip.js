// A table of the lines of the figures below it. A click hides or shows a line, a double click or the key S shows it alone, and once
// more those that were shown before. Which, the server says: what was clicked is all that it is told.

export function render({model, el}) {
  const rowAt = (target) => target.closest(".card")
  let told // the row that is pointed at or has the focus

  // What an observer is, in place of the legend.
  const describe = () => {
    const about = el.querySelector(".about")
    if (about) about.textContent = told?.dataset.about ?? ""
  }
  const tell = ({target}) => {
    told = rowAt(target)
    describe()
  }
  for (const type of ["pointerover", "focusin", "focusout"]) el.addEventListener(type, tell)
  el.onpointerleave = () => tell({target: el})

  // Rows are marked at once; what the server says of it follows.
  el.onclick = ({target}) => {
    const row = rowAt(target), areAll = target.dataset.do === "lines"
    if (row) row.ariaPressed = row.ariaPressed !== "true"
    for (const it of areAll ? el.querySelectorAll(".card") : []) it.ariaPressed = true
  }
  const showAlone = ({target}) => {
    const row = rowAt(target)
    if (!row) return
    const isAlone = el.querySelectorAll("[aria-pressed=true]").length === 1 && row.ariaPressed === "true"
    for (const it of isAlone ? [] : el.querySelectorAll(".card")) it.ariaPressed = it === row
    model.send_msg({action: "solo", name: row.value})
  }
  el.ondblclick = showAlone
  el.onkeydown = (event) => { if (keyAlone(event).toLowerCase() === "s") showAlone(event) }
  showMarkup(el, model, describe)
}
