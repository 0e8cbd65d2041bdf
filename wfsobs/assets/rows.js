// A table of numbers edited in place: rows and columns come from Python, edits go back as messages. Its lines are text, but for the
// one that is edited, to which a click or the arrow keys lead: one stop of the Tab key for each of its cells, not for all there are.

const MOST = 6 // columns of a table

export function render({model, el}) {
  const box = document.createElement("div")
  box.className = "peaks"
  const noun = `${model.noun[0].toUpperCase()}${model.noun.slice(1)}`
  const note = document.createElement("div")
  note.className = "note"
  note.setAttribute("role", "alert")
  const known = new WeakMap() // cell -> its text as sent or received
  let shape = "" // which cells there are
  let current = 0 // the line that is edited
  let next = "" // where the focus goes when the rows have changed
  const add = document.createElement("button")
  add.type = "button"
  add.className = "add"
  add.textContent = `+ Add ${model.noun}`
  add.onclick = () => {
    current = model.rows.length
    next = `[data-cell^="${model.rows.length}."]`
    model.send_msg({action: "add"})
  }
  const scroll = document.createElement("div")
  scroll.className = "rows"
  box.append(scroll, note, add)
  el.append(box)

  const cell = (row, column, value) => {
    const input = document.createElement(column.choices.length ? "select" : "input")
    input.append(...column.choices.map((choice) => new Option(choice)))
    put(input, value)
    input.inputMode = "decimal"
    input.dataset.cell = `${row}.${column.key}`
    input.setAttribute("aria-label", `${noun} ${row + 1}: ${column.name}`)
    input.onchange = () => {
      known.set(input, input.value)
      model.send_msg({action: "edit", row, key: column.key, text: input.value})
    }
    return input
  }

  // Give a cell its text, unless one is being typed there.
  const put = (input, text) => {
    const typing = input === el.getRootNode().activeElement && input.value !== known.get(input)
    if (known.get(input) === text) return
    known.set(input, text)
    if (!typing) input.value = text
  }

  const remover = (i) => {
    const remove = document.createElement("button")
    remove.type = "button"
    remove.className = "remove"
    remove.textContent = "×"
    remove.title = `Remove ${model.noun} ${i + 1}`
    remove.setAttribute("aria-label", remove.title)
    remove.dataset.remove = i
    remove.onclick = () => {
      current = Math.max(0, Math.min(i, model.rows.length - 2))
      next = `[data-remove="${current}"]`
      model.send_msg({action: "remove", row: i})
    }
    return remove
  }

  // Few columns make a table, a line per item; of many, each item has a block with the settings that mean something in it.
  const drawTable = () => {
    const table = document.createElement("table")
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
      const open = isOpen(i)
      model.columns.forEach((column, j) => {
        const at = line.insertCell()
        if (open) at.append(cell(i, column, row[j]))
        else Object.assign(at.dataset, {cell: `${i}.${column.key}`})
      })
      const last = line.insertCell()
      if (open) last.append(remover(i))
    })
    return [table]
  }

  const drawBlocks = () => model.rows.map((row, i) => {
    const block = document.createElement("fieldset")
    const name = document.createElement("legend")
    name.textContent = `${noun} ${i + 1}`
    block.append(name, remover(i))
    model.columns.forEach((column, j) => {
      if (row[j] === null) return
      const label = document.createElement("label")
      label.textContent = column.name
      label.title = column.doc
      label.append(cell(i, column, row[j]))
      block.append(label)
    })
    return block
  })

  const isOpen = (i) => i === current || Object.keys(model.errors).some((at) => at.startsWith(`${i}.`))

  const draw = () => {
    const before = shape
    shape = JSON.stringify(model.rows.map((row, i) => [isOpen(i), ...row.map((text) => text === null)]))
    if (shape === before) mark()
    else redraw()
  }

  const redraw = () => {
    const focused = el.getRootNode().activeElement?.dataset?.cell
    const top = scroll.scrollTop
    scroll.replaceChildren(...(model.columns.length > MOST ? drawBlocks() : drawTable()))
    mark()
    scroll.scrollTop = top
    if (next) {
      (scroll.querySelector(next) ?? add).focus()
    } else if (focused) {
      scroll.querySelector(`[data-cell="${focused}"]`)?.focus()
    }
    next = ""
  }

  // Edit a line, from one of its cells on.
  const edit = (row, at) => {
    current = row
    next = `[data-cell="${at}"]`
    draw()
  }
  scroll.addEventListener("click", (event) => {
    const at = event.target.closest("td[data-cell]")?.dataset.cell
    if (at) edit(Number(at.split(".")[0]), at)
  })
  scroll.addEventListener("keydown", (event) => {
    const [row, ...key] = (event.target.closest("tbody tr")?.querySelector("[data-cell]").dataset.cell ?? "").split(".")
    const to = Number(row) + ({ArrowDown: 1, ArrowUp: -1}[event.key] ?? NaN)
    if (!key.length || !(to in model.rows) || event.target.tagName === "SELECT") return
    event.preventDefault()
    const column = model.columns[event.target.closest("td").cellIndex] ?? model.columns[0]
    event.target.blur() // takes over what was typed
    edit(to, `${to}.${column.key}`)
  })

  const mark = () => {
    const errors = model.errors
    scroll.querySelectorAll("[data-cell]").forEach((input) => {
      const [row, ...key] = input.dataset.cell.split(".")
      const column = model.columns.findIndex((it) => it.key === key.join("."))
      if (input.tagName === "TD") return input.replaceChildren(model.rows[row]?.[column] ?? "")
      const error = errors[input.dataset.cell]
      put(input, error?.text ?? model.rows[row]?.[column] ?? known.get(input))
      input.setAttribute("aria-invalid", error ? "true" : "false")
    })
    note.textContent = Object.values(errors).map((error) => error.reason).join("\n")
  }

  model.on("rows", draw)
  model.on("errors", draw)
  draw()
}
