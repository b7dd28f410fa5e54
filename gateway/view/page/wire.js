// The page's end of the wire: gateway/view/cockpit.py says what goes over it. Nothing is sent by itself.

const RETRY = 1000; // ms between attempts to connect
const SILENT = 1500; // ms without a message after which a person is told

export class Wire {
  // `on`: by the kind of a message, what takes (content, arrays' bytes); `lost`: takes why, or "" when it is back.
  constructor(path, on, lost) {
    Object.assign(this, { path, on, lost, asked: new Map(), id: 0, heard: 0, why: null });
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
    this.socket.onclose = event => {
      this.asked.clear();
      const why = event.reason ? `: ${event.reason}` : "";
      this.tell(`Not connected${why}. The robot does not hear this page. Trying again …`);
      setTimeout(() => this.connect(), RETRY);
    };
  }

  watch() {
    const silence = performance.now() - this.heard;
    if (this.open && this.heard && silence > SILENT)
      this.tell(`Nothing heard for ${Math.round(silence / 1000)} s: what is shown is old.`);
  }

  tell(why) {
    if (why !== this.why) this.lost((this.why = why), this.open);
  }

  receive(data) {
    this.heard = performance.now();
    this.tell("");
    let message, bytes;
    if (typeof data === "string") message = JSON.parse(data);
    else {
      const length = new DataView(data).getUint32(0, true);
      message = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
      bytes = { buffer: data, offset: 4 + length };
    }
    if (message.kind === "answer") {
      const take = this.asked.get(message.id);
      this.asked.delete(message.id);
      (take || this.on.answer)(message);
    } else this.on[message.kind]?.(message, bytes);
  }

  send(message) {
    if (this.open) this.socket.send(JSON.stringify(message));
    return this.open;
  }

  // Ask for something once; `take` gets the answer {ok, text}, if it is not for everybody.
  ask(line, take) {
    const id = ++this.id;
    if (this.send({ ask: line, id }) && take) this.asked.set(id, take);
  }
}

// Something that is asked for as long as it is held. The robot ends it 200 ms after the last message.
export class Held {
  constructor(wire) {
    Object.assign(this, { wire, timer: 0, line: null });
    for (const [target, type] of [[window, "blur"], [window, "pagehide"], [document, "visibilitychange"]])
      target.addEventListener(type, () => this.end());
  }

  // `line` returns what is held now: a line of the operator's language.
  begin(line, ended = () => {}) {
    this.end();
    Object.assign(this, { line, ended, timer: setInterval(() => this.repeat(), 50) });
    this.repeat();
  }

  repeat() {
    if (!this.wire.send({ held: this.line() })) this.end(); // what nobody hears does not begin later by itself
  }

  end() {
    if (!this.timer) return;
    clearInterval(this.timer);
    this.timer = 0;
    this.wire.send({ held: "" });
    this.ended();
  }
}
