// The state of the run: a bar, a line, and what was refused. Drawn here, so that progress costs no layout of the page.

export function render({model, el}) {
  const bar = document.createElement("progress")
  bar.max = 1
  bar.setAttribute("aria-label", model.label)
  const line = document.createElement("div")
  line.className = "line"
  line.setAttribute("role", "status")
  const note = document.createElement("div")
  note.className = "note"
  note.setAttribute("role", "alert")
  el.append(bar, line, note)

  const draw = () => {
    bar.value = model.progress
    line.textContent = model.text
    note.textContent = note.title = model.note
  }
  for (const name of ["progress", "text", "note"]) {
    model.on(name, draw)
  }
  draw()
}
