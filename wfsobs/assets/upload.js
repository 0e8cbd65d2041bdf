// Loading a record: the sheet, the file sent in parts, and what there is to say about it.

const RECORDS = ".npz,.npy,.csv,.txt,.dat,.tsv,.asc,.fits,.fit,.fts,.mat,.h5,.hdf5,.hdf,.he5,.sav,.idl,.parquet,.pq"

export function render({model, el}) {
  const draw = () => {
    setMarkup(el, model.html)
    el.getRootNode().host.style.position = model.source_title || model.message ? "" : "absolute"
  }
  for (const name of ["html", "source_title", "message"]) model.on(name, draw)  // which come one after the other
  draw()
  const [input, sheet, cover] = ["input", "#load", ".cover"].map((it) => el.querySelector(it))
  const take = async (file) => {
    if (/\.toml$/i.test(file.name) && file.size <= model.part) model.send_msg({action: "scenario", name: file.name, text: await file.text()})
    else send(model, file)
  }
  tellActions(el, model)
  handleFiles(el, take)

  // A file may be dropped anywhere; while one is over the page, a cover says so.
  const over = (event) => {
    if (!event.dataTransfer?.types.includes("Files")) return false
    event.preventDefault()
    event.dataTransfer.dropEffect = "copy"
    cover.hidden = event.type === "drop"
    return true
  }
  const events = {
    dragover: over,
    dragenter: over,
    dragleave: (event) => { cover.hidden ||= !event.relatedTarget },
    drop: (event) => { if (over(event) && event.dataTransfer.files[0]) take(event.dataTransfer.files[0]) },
    "wfsobs:load": () => { input.accept = RECORDS; sheet.showPopover() },
    "wfsobs:open": () => { input.accept = ".toml,.wfsobs-session"; input.click() },
  }
  const stop = new AbortController()
  for (const [type, act] of Object.entries(events)) document.addEventListener(type, act, {signal: stop.signal})
  model.on("remove", () => stop.abort())
}
