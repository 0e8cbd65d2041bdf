// The state of the run. Drawn here, so that progress costs no layout of the page.

export function render({model, el}) {
  el.innerHTML = `<progress max="1"></progress><div class="line" role="status"></div><div class="note" role="alert"></div>`
  const [bar, line, note] = el.children
  bar.ariaLabel = model.label
  const draw = () => {
    bar.value = model.progress
    line.textContent = model.text
    note.textContent = note.title = model.note
  }
  model.on(["progress", "text", "note"], draw)
  draw()
}
