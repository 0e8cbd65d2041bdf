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

  el.onclick = ({target}) => { // at once; what the server says of it follows
    const row = rowAt(target)
    if (row) row.ariaPressed = row.ariaPressed !== "true"
  }
  const showAlone = ({target}) => { if (rowAt(target)) model.send_msg({action: "solo", name: rowAt(target).value}) }
  el.ondblclick = showAlone
  el.onkeydown = (event) => { if (keyAlone(event).toLowerCase() === "s") showAlone(event) }
  showMarkup(el, model, describe)
}
