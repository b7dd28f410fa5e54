// The page's end of the wire: gateway/view/cockpit.py describes what goes over it. Nothing is sent by itself, but that the
// page is still there, and which signals it plots.

const RETRY = 1000; // ms between attempts to connect
const SILENT = 1500; // ms without a message after which a person is warned,
const DEAD = 5000; // and after which the connection is made anew
const ALIVE = 2000; // ms between two messages that the page is still there

export class Wire {
  // `on`: by the kind of a message, what takes (content, arrays' bytes); `lost`: takes why, or "" when it is back.
  constructor(path, on, lost) {
    Object.assign(this, { path, on, lost, asked: new Map(), id: 0, alive: 0, why: null, known: false });
    this.connect();
    setInterval(() => this.watch(), 250);
  }

  get open() {
    return this.socket.readyState === WebSocket.OPEN;
  }

  connect() {
    const scheme = location.protocol === "https:" ? "wss://" : "ws://";
    const token = new URLSearchParams(location.search).get("token");
    const query = token ? `?token=${encodeURIComponent(token)}` : "";
    this.socket = new WebSocket(scheme + location.host + this.path + query);
    this.socket.binaryType = "arraybuffer";
    this.socket.onmessage = event => this.receive(event.data);
    this.socket.onclose = event => this.drop(event.reason);
    this.receivedAt = performance.now();
    this.clock = undefined; // of the gateway, newest
  }

  drop(reason) {
    this.socket.onmessage = this.socket.onclose = null;
    this.socket.close();
    this.receivedAt = performance.now();
    this.asked.clear();
    this.warn(`Not connected${reason && `: ${reason}`}. The robot receives nothing from this page. Trying again …` +
      (this.known ? "" : " Open the address that the gateway printed, with its token."));
  }

  watch() {
    const silence = performance.now() - this.receivedAt;
    if (this.socket.onclose === null) {
      if (silence > RETRY) this.connect();
    } else if (silence > DEAD) this.drop("");
    else if (this.open && silence > SILENT) this.warn("No data from the robot. What is shown is old.");
  }

  warn(why) {
    if (why !== this.why) this.lost((this.why = why), this.open);
  }

  receive(data) {
    this.receivedAt = performance.now();
    this.known = true;
    this.warn("");
    if (this.receivedAt - this.alive > ALIVE) {
      this.alive = this.receivedAt;
      this.send({});
    }
    let message, bytes;
    if (typeof data === "string") message = JSON.parse(data);
    else {
      const length = new DataView(data).getUint32(0, true);
      message = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
      bytes = { buffer: data, offset: 4 + length };
    }
    this.clock = message.clock ?? this.clock;
    if (message.kind === "answer") {
      const take = this.asked.get(message.id);
      this.asked.delete(message.id);
      (take ?? this.on.answer)(message);
    } else this.on[message.kind]?.(message, bytes);
  }

  // While nothing comes from the robot, it would do later, and unseen, what is sent: then only what is `always` safe is.
  send(message, always = false) {
    const can = this.open && (always || !this.why);
    if (can) this.socket.send(JSON.stringify(message));
    return can;
  }

  // Ask for something once; `take` gets the answer {ok, text}.
  ask(line, take = this.on.answer) {
    const id = ++this.id;
    if (this.send({ ask: line, id, heard: this.clock }, /^stop\b/.test(line))) this.asked.set(id, take);
    else take({ ok: false, text: "not sent: no data from the robot" });
  }
}

// Something that is asked for as long as it is held. The robot ends it 200 ms after the last message, and refuses a
// message that was sent long ago, as the newest of its own times in it shows.
export class Held {
  // `refused`: takes why the robot ended it, or "" when something is held anew.
  constructor(wire, refused) {
    Object.assign(this, { wire, refused, timer: 0, line: null });
    for (const [target, type] of [[window, "blur"], [window, "pagehide"], [document, "visibilitychange"]])
      target.addEventListener(type, () => this.end());
    // What may swallow the release of a key: a menu, a drag, and on macOS Cmd, while which no letter has one.
    for (const type of ["contextmenu", "dragstart"])
      window.addEventListener(type, event => event.defaultPrevented || this.end());
    window.addEventListener("keydown", event => (event.metaKey || event.ctrlKey || event.altKey) && this.end());
  }

  // `line` returns what is held now: a line of the operator's language.
  begin(line, ended = () => {}) {
    this.end();
    this.refused("");
    Object.assign(this, { line, ended, timer: setInterval(() => this.repeat(), 50) });
    this.repeat();
  }

  repeat() {
    if (!this.wire.send({ held: this.line(), heard: this.wire.clock })) this.end(); // what is not received does not begin later by itself
  }

  end() {
    if (!this.timer) return;
    clearInterval(this.timer);
    this.timer = 0;
    this.wire.send({ held: "" }, true);
    this.ended();
  }
}
