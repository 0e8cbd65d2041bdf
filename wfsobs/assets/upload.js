// Loading a record: the dialog, the file sent in parts, and what there is to say about it.

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
  const drop = (event) => {
    cover.hidden = true
    if (!isFile(event)) return
    event.preventDefault()
    if (event.dataTransfer.files[0]) take(event.dataTransfer.files[0])
  }
  const take = async (file) => {
    if (/\.toml$/i.test(file.name) && file.size <= model.part) model.send_msg({action: "scenario", name: file.name, text: await file.text()})
    else send(model, file)
  }
  const listeners = {dragover: over, dragenter: over, dragleave: leave, drop, "wfsobs:file": (event) => take(event.detail)}
  for (const [name, act] of Object.entries(listeners)) document.addEventListener(name, act)
  model.on("remove", () => { for (const [name, act] of Object.entries(listeners)) document.removeEventListener(name, act) })
}

const FORMAT = "CSV or other text, NPZ, MATLAB, HDF5, FITS, AOT, Parquet or IDL: a row per step, measurements, commands and the time or the rate; or a vibration spectrum. A file may also be dropped anywhere on the page; columns with other names can be mapped after loading."

// What a file looks like, a template to fill in, a sample, and the button that chooses one.
function dialog(model, el, choose) {
  const sheet = Object.assign(document.createElement("dialog"), {className: "load"})
  sheet.setAttribute("aria-label", "Load data")
  sheet.append(Object.assign(document.createElement("p"), {textContent: FORMAT}))
  const send = (action) => () => model.send_msg({action})
  for (const [textContent, act] of [["Choose a file", choose], ["Template CSV", send("template")], ["Sample record", send("sample")], ["Close", () => {}]]) {
    const button = Object.assign(document.createElement("button"), {type: "button", textContent})
    button.onclick = () => { sheet.close(); act() }
    sheet.append(button)
  }
  el.append(sheet)
  const open = () => { paint(sheet); sheet.showModal() }
  document.addEventListener("wfsobs:load", open)
  model.on("remove", () => document.removeEventListener("wfsobs:load", open))
}

export function render({model, el}) {
  const bar = document.createElement("div")
  bar.className = "bar"
  const input = Object.assign(document.createElement("input"), {type: "file", hidden: true, accept: ".npz,.npy,.csv,.txt,.dat,.tsv,.asc,.fits,.fit,.fts,.mat,.h5,.hdf5,.hdf,.he5,.sav,.idl,.parquet,.pq"})
  input.setAttribute("aria-label", "Record file")
  input.onchange = () => {
    if (input.files[0]) send(model, input.files[0])
    input.value = ""
  }
  const back = Object.assign(document.createElement("button"), {type: "button"})
  back.onclick = () => model.send_msg({action: "simulate"})
  const loaded = document.createElement("span")
  const said = Object.assign(document.createElement("span"), {className: "said"})
  said.setAttribute("role", "status")
  bar.append(input, loaded, back, said)
  el.append(bar)
  dialog(model, el, () => input.click())
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
    el.getRootNode().host.style.position = model.source_title || model.message ? "" : "absolute"
  }
  model.on("source_title", draw)
  model.on("back", draw)
  model.on("message", draw)
  draw()
}
