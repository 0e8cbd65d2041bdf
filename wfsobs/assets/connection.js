// Watches the connection to the server: says when it is lost, takes it up again where the server still has the session, and keeps
// what was changed meanwhile. One for the document, which outlives what is drawn of it.

const TICK = 250 // [ms]; only those count in which this page gets to work
const PATIENCE = 16 // with a question: another visitor's page takes the server two seconds [ticks]
const GIVEN_UP = 40 // after which a request beside the socket tells whether the server is there [ticks]
const PERIOD = 12 // between questions where nothing is changed [ticks]
const TIMEOUT = 3_000 // of a question beside the connection [ms]
const LONGEST = 3_000 // between two attempts to connect [ms]
const REFUSALS = 5 // of a server that answers, after which it has no such session
const UNSENT = "wfsobs-unsent"
const TYPED = ["value", "value_input", "value_throttled"]

const LATER = " Results are as they were; what you change is kept for later."
const SAID = {
  connected: "Connected again.",
  offline: "This computer is offline." + LATER,
  silent: "The server does not answer." + LATER,
  lost: "The connection to the server is lost: connecting again …" + LATER,
  gone: "The server does not have this session any more.",
}

// Whether the server answers at all: a file of its own, not from a cache.
async function reachable() {
  const file = [...document.scripts].find((script) => script.src.includes("static/"))?.src ?? location.href
  try {
    return (await fetch(file, {method: "HEAD", cache: "no-store", signal: AbortSignal.timeout(TIMEOUT)})).ok
  } catch {
    return false
  }
}

// The socket that something is sent by.
function socketOf(act) {
  const {send} = WebSocket.prototype
  let socket = null
  WebSocket.prototype.send = function (...args) {
    socket = this
    return send.apply(this, args)
  }
  try {
    act()
  } finally {
    WebSocket.prototype.send = send
  }
  return socket
}

// A server may send a change before its greeting; Bokeh then refuses the socket with a code that browsers do not take.
function refuse(event) {
  if (!event.data.includes('"ACK"')) event.target.close()
}

// The path of the setting that a component stands for.
const settingOf = (model) => model?.tags?.find((tag) => tag.startsWith?.(TAG))?.slice(TAG.length)

// A line below a setting that comes while it is being drawn is not seen.
function areSettingsDrawn() {
  const fields = [...Bokeh.index.query((it) => settingOf(it.model))]
  return fields.length > 0 && fields.every((it) => it.has_finished())
}

class Link {
  state = "connected"
  asked = 0
  unsent = []
  kept = new Set()
  refused = 0
  wait = 0
  ticks = 0
  isThere = false

  constructor(doc) {
    this.doc = doc
    doc.on_change((event) => this.changed(event))
    doc.on_event("connection_lost", (_, event) => this.lost(event.connection.deref()))
    window.addEventListener("offline", () => {
      if (this.state !== "gone") this.turn("offline")
      this.ask()
    })
    window.addEventListener("online", () => this.connection ? this.retry() : this.ask())
    document.addEventListener("visibilitychange", () => this.ask())
    setInterval(() => this.tick(), TICK)
  }

  // The document is drawn, for the first time or anew.
  attach(model, draw) {
    if (this.model === undefined) this.restore()
    Object.assign(this, {model, draw, session: model.session, arrived: model.last_arrival})
    model.on("last_arrival", () => this.answered(model.last_arrival))
    this.due = true
    this.deliver()
    this.turn("connected")
  }

  turn(state) {
    const before = this.state
    this.state = state
    this.draw(state === "connected" && before === "connected" ? "" : SAID[state], state)
  }

  fail(state) {
    this.turn(navigator.onLine ? state : "offline")
  }

  ask() {
    if (!this.model || !this.ready) return
    if (this.asked === this.model.last_arrival) this.ticks = 0
    this.asked += 1
    this.watch(socketOf(() => this.model.send_msg({ask: this.asked})))
  }

  watch(socket) {
    if (!socket || socket === this.socket) return
    this.socket = socket
    socket.addEventListener("message", () => { this.ticks = 0 }) // whatever comes is a sign of life
  }

  tick() {
    if (!this.model || document.hidden) return
    this.deliver()
    this.ticks += 1
    const waiting = this.asked > this.model.last_arrival
    if (!waiting && (this.unsent.length || this.ticks >= PERIOD)) this.ask()
    if (waiting && this.ticks === PATIENCE) this.fail("silent")
    if (!waiting || this.ticks < GIVEN_UP) return
    if (this.ticks % GIVEN_UP === 0) reachable().then((it) => { this.isThere = it })
    if (this.ticks % GIVEN_UP === PATIENCE && this.isThere) this.another()
  }

  answered(number) {
    this.ticks = 0
    if (!this.due) this.unsent = this.unsent.filter((it) => it.number > number)
    this.keep()
    if (["offline", "silent"].includes(this.state)) this.turn("connected")
  }

  // The server is there, but does not answer by this socket. Counted in ticks, as a busy page reads late what has arrived.
  another() {
    const {socket} = this
    if (!socket) return
    socket.send = () => {} // until it is closed: what is changed is kept
    socket.close()
  }

  // A lost connection is not used again: its reader may be in the middle of a message.
  lost(connection) {
    this.connection = connection
    this.model = null
    connection.close()
    this.fail("lost")
    this.retry()
  }

  async retry() {
    clearTimeout(this.retrying)
    if (this.trying || this.state === "gone") return
    this.trying = true
    const {constructor: Connection, url, token, args_string} = this.connection
    const fresh = this.connection = new Connection(url, token, args_string), {send} = fresh
    fresh.send = (message) => { if (message.msgtype() !== "PATCH-DOC") send.call(fresh, message) } // the server has all that it sends
    try {
      const connected = fresh.connect(), {socket} = fresh
      socket?.addEventListener("message", refuse, {once: true})
      this.watch(socket)
      this.take(await connected)
    } catch {
      this.refused = await reachable() ? this.refused + 1 : 0
      if (this.refused > REFUSALS) return this.turn("gone")
      this.fail("lost")
      this.wait = Math.min(2 * this.wait + 500, LONGEST)
      this.retrying = setTimeout(() => this.retry(), this.wait)
    } finally {
      this.trying = false
    }
  }

  // The document as the server has it, in place of the one that is shown.
  take(session) {
    const {doc, connection} = this, {document: pulled} = session
    if (![...pulled.all_models].some((it) => it.session === this.session)) {
      session.close()
      return this.turn("gone")
    }
    focused()?.blur()  // what is being typed counts as typed: its box is about to be drawn anew
    pulled.destructively_move(doc)
    doc.create_json_patch([]) // no model is new to the server
    delete connection.send
    connection.session = new session.constructor(connection, doc)
    this.kept = new Set(this.unsent) // what comes now is sent as ever
    this.wait = this.refused = this.ticks = 0
    this.connection = this.model = null // until it is drawn
  }

  // As soon as the server answers.
  async again() {
    if (!await reachable()) {
      this.draw(SAID.gone + " It does not answer yet.", "gone")
      return setTimeout(() => this.again(), LONGEST)
    }
    this.keep()
    location.reload()
  }

  // What is changed may not arrive.
  changed(event) {
    if (!event.sync) return
    const number = this.asked + 1
    if (event.kind === "ModelChanged" && TYPED.includes(event.attr)) {
      const {id} = event.model, holder = [...this.doc.all_models].find((it) => it.data === event.model)
      const setting = settingOf(holder ?? event.model)
      this.unsent = this.unsent.filter((it) => (setting ? it.setting !== setting : it.id !== id) || it.message)
      this.note({number, id, setting, attr: event.attr, value: event.value})
    } else if (event.kind === "MessageSent") {
      const {origin, data} = event.msg_data ?? {}, setting = data?.action && settingOf(origin)
      if (setting) this.note({number, id: origin.id, setting, message: data})
    }
  }

  note(it) {
    this.unsent.push(it)
    this.keep()
    queueMicrotask(() => this.ask())
  }

  // What the server changes before the page is drawn is not seen.
  deliver() {
    this.ready ||= this.doc.is_idle
    if (!this.ready || !this.due || !areSettingsDrawn()) return
    this.due = false
    this.unsent = this.unsent.filter((it) => it.number > this.arrived)
    this.send(this.unsent.filter((it) => this.kept.has(it)))
  }

  send(changes) {
    for (const it of changes) it.number = this.asked + 1
    const settings = changes.filter((it) => it.setting)
    if (settings.length) this.model.send_msg({changes: settings})
    for (const {id, attr, value} of changes.filter((it) => !it.setting)) {
      const model = this.doc.get_model_by_id(id)
      if (model) model[attr] = value
    }
    this.ask()
  }

  keep() {
    kept(UNSENT, this.unsent.length ? JSON.stringify([location.search, this.unsent]) : null, "sessionStorage")
  }

  restore() {
    const [search, unsent] = JSON.parse(kept(UNSENT, undefined, "sessionStorage") ?? "[]")
    if (search === location.search) this.unsent = unsent.map((it) => ({...it, id: "", number: 1}))
    this.kept = new Set(this.unsent)
  }
}

export function render({model, view, el}) {
  const doc = view.model.document
  el.innerHTML = `<div class="banner" popover="manual" role="alert"><span></span><button type="button">Start again with these settings</button></div>`
  const box = el.firstChild, [text, button] = box.children
  button.onclick = () => doc.wfsobs.again()
  const draw = (said, state) => {
    box.dataset.state = state
    text.textContent = said
    button.hidden = state !== "gone"
    box.togglePopover(said !== "")
  }
  doc.wfsobs ??= new Link(doc)
  doc.wfsobs.attach(model, draw)
}
