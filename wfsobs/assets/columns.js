// Which column of a file is what: a row per column, its name, its first values, and a choice.

export function render({model, el}) {
  const add = (kind, parent, properties = {}) => {
    const made = Object.assign(document.createElement(kind), properties)
    parent.append(made)
    return made
  }
  const scroll = add("div", el, {className: "scroll"})
  scroll.tabIndex = 0
  scroll.setAttribute("role", "region")
  scroll.setAttribute("aria-label", "Columns of the file")
  let choices = {}

  const fill = () => {
    const roles = Object.fromEntries(Object.entries(model.roles).map(([role, name]) => [name, role]))
    for (const [name, select] of Object.entries(choices)) {
      select.value = roles[name] ?? ""
      select.closest("tr").className = roles[name] ? "said" : ""
    }
  }
  const draw = () => {
    scroll.replaceChildren()
    choices = {}
    const table = add("table", scroll)
    add("caption", table, {textContent: model.hint})
    const head = add("tr", add("thead", table))
    for (const text of ["Column", "Values", "Is"]) add("th", head, {textContent: text, scope: "col"})
    const body = add("tbody", table)
    for (const [name, about] of Object.entries(model.columns)) {
      const row = add("tr", body)
      add("th", row, {textContent: name, scope: "row"})
      add("td", row, {textContent: about, className: "values"})
      const select = add("select", add("td", row))
      select.setAttribute("aria-label", `Meaning of ${name}`)
      add("option", select, {value: "", textContent: "–"})
      for (const [role, label] of Object.entries(model.labels)) add("option", select, {value: role, textContent: label})
      select.onchange = () => model.send_msg({column: name, role: select.value})
      choices[name] = select
    }
    fill()
  }
  model.on("columns", draw)
  model.on("roles", fill)
  draw()
}
