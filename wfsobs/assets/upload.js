// Loading a record: the button, the file sent in parts, and what there is to say about it.

// A file may be dropped anywhere; while one is over the page, a cover says so.
function takeDrops(model, root) {
  const cover = Object.assign(document.createElement("div"), {className: "cover", hidden: true, textContent: "Drop a record, a spectrum, a scenario or a session"})
  root.append(cover)
  const isFile = (event) => [...(event.dataTransfer?.types ?? [])].includes("Files")
  const over = (event) => {
    if (!isFile(event)) return
    event.preventDefault()
    event.dataTransfer.dropEffect = "copy"
    cover.hidden = false
  }
  const leave = (event) => { if (!event.relatedTarget) cover.hidden = true }
  const drop = async (event) => {
    cover.hidden = true
    if (!isFile(event)) return
    event.preventDefault()
    const file = event.dataTransfer.files[0]
    if (!file) return
    if (/\.toml$/i.test(file.name) && file.size <= model.part) model.send_msg({action: "scenario", name: file.name, text: await file.text()})
    else send(model, file)
  }
  const listeners = {dragover: over, dragenter: over, dragleave: leave, drop}
  for (const [name, act] of Object.entries(listeners)) document.addEventListener(name, act)
  model.on("remove", () => { for (const [name, act] of Object.entries(listeners)) document.removeEventListener(name, act) })
}

// What a file looks like: a template to fill in, and a sample.
function examples(model, bar) {
  const details = document.createElement("details")
  details.append(Object.assign(document.createElement("summary"), {textContent: "File format"}))
  const list = document.createElement("div")
  list.append(Object.assign(document.createElement("p"), {textContent: "CSV, NPZ, FITS or AOT: a row per step, measurements, commands and the time or the rate. A file may be dropped anywhere on the page; columns with other names can be mapped after loading."}))
  for (const [action, textContent] of [["template", "Template CSV"], ["sample", "Sample record"]]) {
    const button = Object.assign(document.createElement("button"), {type: "button", textContent})
    button.onclick = () => model.send_msg({action})
    list.append(button)
  }
  details.append(list)
  bar.append(details)
}

export function render({model, el}) {
  const bar = document.createElement("div")
  bar.className = "bar"
  const input = Object.assign(document.createElement("input"), {type: "file", hidden: true, accept: ".npz,.csv,.txt,.fits,.fit,.fts"})
  input.setAttribute("aria-label", "Record file")
  input.onchange = () => {
    if (input.files[0]) send(model, input.files[0])
    input.value = ""
  }
  const open = Object.assign(document.createElement("button"), {type: "button", textContent: "Load data"})
  open.title = "A record of telemetry in place of the simulation, or a vibration spectrum: .npz, .csv, .fits"
  open.onclick = () => input.click()
  const back = Object.assign(document.createElement("button"), {type: "button"})
  back.onclick = () => model.send_msg({action: "simulate"})
  const loaded = document.createElement("span")
  const said = Object.assign(document.createElement("span"), {className: "said"})
  said.setAttribute("role", "status")
  bar.append(input, open)
  examples(model, bar)
  bar.append(loaded, back, said)
  el.append(bar)
  takeDrops(model, el)
  model.on("msg:custom", (event) => {
    const {name, kind, content} = event.data ?? event
    save(name, kind, content)
  })
  const draw = () => {
    loaded.textContent = model.source_title
    back.hidden = !model.source_title
    back.textContent = model.back
    said.textContent = model.message
  }
  model.on("source_title", draw)
  model.on("back", draw)
  model.on("message", draw)
  draw()
}
