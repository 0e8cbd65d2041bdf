// Files that the browser saves: made here, or sent by the server.

function save(name, blob) {
  const url = URL.createObjectURL(blob)
  Object.assign(document.createElement("a"), {href: url, download: name}).click()
  setTimeout(() => URL.revokeObjectURL(url), 60_000)
}

function takeFiles(model, done = () => {}) {
  model.on("msg:custom", (event) => {
    const {name, kind, content} = event.data ?? event
    save(name, new Blob([Uint8Array.from(atob(content), (c) => c.charCodeAt(0))], {type: kind}))
    done(name)
  })
}
