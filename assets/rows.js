// A table of numbers edited in place: rows and columns come from Python, edits go back as messages.

export function render({model, el}) {
  const box = document.createElement("div")
  box.className = "peaks"
  const table = document.createElement("table")
  const note = document.createElement("div")
  note.className = "note"
  note.setAttribute("role", "alert")
  const add = document.createElement("button")
  add.type = "button"
  add.className = "add"
  add.textContent = `+ Add ${model.noun}`
  add.onclick = () => model.send_msg({action: "add"})
  const scroll = document.createElement("div")
  scroll.className = "rows"
  scroll.append(table)
  box.append(scroll, note, add)
  el.append(box)

  const cell = (row, column, value) => {
    const input = document.createElement(column.choices.length ? "select" : "input")
    input.append(...column.choices.map((choice) => new Option(choice)))
    input.value = value
    input.inputMode = "decimal"
    input.dataset.cell = `${row}.${column.key}`
    input.setAttribute("aria-label", `${model.noun[0].toUpperCase()}${model.noun.slice(1)} ${row + 1}: ${column.name}`)
    input.onchange = () => model.send_msg({action: "edit", row, key: column.key, text: input.value})
    return input
  }

  const draw = () => {
    const focused = el.getRootNode().activeElement?.dataset?.cell
    const top = scroll.scrollTop
    table.replaceChildren()
    table.style.minWidth = `${64 * model.columns.length}px`
    const head = table.createTHead().insertRow()
    for (const column of model.columns) {
      const th = document.createElement("th")
      th.scope = "col"
      th.textContent = column.name
      th.title = column.doc
      head.append(th)
    }
    head.append(document.createElement("td"))
    const body = table.createTBody()
    model.rows.forEach((row, i) => {
      const line = body.insertRow()
      model.columns.forEach((column, j) => line.insertCell().append(cell(i, column, row[j])))
      const remove = document.createElement("button")
      remove.type = "button"
      remove.className = "remove"
      remove.textContent = "×"
      remove.title = `Remove ${model.noun} ${i + 1}`
      remove.setAttribute("aria-label", `Remove ${model.noun} ${i + 1}`)
      remove.onclick = () => model.send_msg({action: "remove", row: i})
      line.insertCell().append(remove)
    })
    mark()
    scroll.scrollTop = top
    if (focused) {
      table.querySelector(`[data-cell="${focused}"]`)?.focus()
    }
  }

  const mark = () => {
    const errors = model.errors
    table.querySelectorAll("input, select").forEach((input) => {
      const error = errors[input.dataset.cell]
      if (error) {
        input.value = error.text
      }
      input.setAttribute("aria-invalid", error ? "true" : "false")
    })
    note.textContent = Object.values(errors).map((error) => error.reason).join("\n")
  }

  model.on("rows", draw)
  model.on("errors", draw)
  draw()
}
