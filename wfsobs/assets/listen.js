// Hear events of the whole page as long as a component is on it: type -> what is done.
function listen(model, heard, options = {}) {
  const stop = new AbortController()
  for (const [type, act] of Object.entries(heard)) document.addEventListener(type, act, {...options, signal: stop.signal})
  model.on("remove", () => stop.abort())
}
