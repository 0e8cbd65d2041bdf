// A map of a sweep: a table with a button per cell, the best observer by its colour and its margin by the shade.
// A click on a cell asks for its scenario; what a cell looks like is the server's to say.

export function render({model, el}) {
  const scroll = document.createElement("div")
  scroll.className = "scroll"
  scroll.tabIndex = 0
  scroll.setAttribute("role", "region")
  const key = document.createElement("div")
  key.className = "key"
  el.append(scroll, key)

  const part = (name, parent, properties = {}) => parent.appendChild(Object.assign(document.createElement(name), properties))

  const button = (cell, parent) => {
    const it = part("button", parent, {type: "button", textContent: cell.text, title: cell.title})
    it.setAttribute("aria-label", cell.title)
    it.dataset.cell = cell.index
    it.dataset.state = cell.state
    for (const name of ["ground", "stripe", "ink"]) it.style.setProperty(`--${name}`, cell[name])
    it.onclick = () => model.send_msg({load: cell.index})
  }

  const draw = () => {
    const {title, across, down, columns, rows, cells} = model.grid
    const focused = el.getRootNode().activeElement?.dataset?.cell
    scroll.setAttribute("aria-label", title ?? "")
    const table = document.createElement("table")
    for (const [i, row] of (rows ?? []).entries()) {
      const line = part("tr", table)
      if (i === 0 && down) part("th", line, {className: "down", rowSpan: rows.length, scope: "rowgroup"}).append(
        Object.assign(document.createElement("span"), {textContent: down}))
      part(row ? "th" : "td", line, row ? {scope: "row", textContent: row} : {})
      for (const cell of cells[i]) button(cell, part("td", line))
    }
    const foot = part("tr", table)
    for (let i = 0; i < (down ? 2 : 1); i++) part("td", foot)
    for (const column of columns ?? []) part("th", foot, {scope: "col", textContent: column})
    const last = part("tr", table)
    for (let i = 0; i < (down ? 2 : 1); i++) part("td", last)
    part("th", last, {className: "across", colSpan: columns?.length ?? 1, scope: "colgroup", textContent: across ?? ""})
    scroll.replaceChildren(table)
    if (focused !== undefined) scroll.querySelector(`[data-cell="${focused}"]`)?.focus()
    key.replaceChildren(...(model.grid.key ?? []).map(([colour, name]) => {
      const mark = document.createElement("span")
      mark.style.setProperty("--ground", colour)
      mark.textContent = name
      return mark
    }))
  }

  model.on("grid", draw)
  draw()
}
