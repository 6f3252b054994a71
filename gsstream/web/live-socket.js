// The connection to a live stream: comes back when it breaks, and knows the server's clock.

/** Pauses before connecting again, in milliseconds; the last one is repeated. */
export const settings = { pauses: [500, 1000, 2000, 4000, 8000], patience: 15_000, ask: 5_000, first: 300 };

/** Why a connection ended, in a sentence for the viewer of the page. */
function reasonOf(opened, { code, reason }, host) {
  if (code === 1013 && reason) return `${reason}`;
  if (code === 1012) return "The server was stopped";
  return opened ? "The connection to the server is cut" : `No live stream answers at ${host}`;
}

/** Keeps a WebSocket of a LiveBuffer open from `start` to `stop`. */
export class LiveSocket {
  constructor(buffer) {
    Object.assign(this, { buffer, socket: null, failures: 0 });
    /** Milliseconds by which the server's clock is ahead of ours, and the round trip in which that was measured. */
    this.ahead = 0;
    this.round = Infinity;
  }

  start() {
    if (this.socket || this.timer) return;
    this._connect();
  }

  stop() {
    clearTimeout(this.timer);
    clearInterval(this.clock);
    this.timer = null;
    const { socket } = this;
    this.socket = null;
    socket?.close();
  }

  /** Give the connection up and begin a new one after a pause: what came is of no use. */
  again(sentence) {
    this.stop();
    this._wait(sentence);
  }

  /** The connection broke. */
  _lost(sentence) {
    if (this.buffer.over) this.stop();
    else this.again(sentence);
  }

  /** Something useful came: the next failure is the first one again. */
  sound() {
    this.failures = 0;
  }

  _connect() {
    this.timer = null;
    const address = this.buffer.address();
    let socket;
    try {
      socket = new WebSocket(address);
    } catch {
      this._wait(`No live stream can be at ${address}`);
      return;
    }
    socket.binaryType = "arraybuffer";
    let opened = false;
    this.socket = socket;
    this.heard = performance.now();
    socket.onopen = () => {
      opened = true;
      if (this.socket !== socket) return;
      this.buffer.opened();
      // A page that is just beginning is busy: the first answers are read late.
      for (let i = 0; i < 8; i += 1) setTimeout(() => this._ask(socket), i * settings.first);
    };
    socket.onmessage = ({ data }) => {
      this.heard = performance.now();
      if (this.socket === socket) this._received(data);
    };
    socket.onclose = (event) => {
      if (this.socket === socket) this._lost(reasonOf(opened, event, new URL(address).host));
    };
    this.clock = setInterval(() => this._watch(), settings.ask);
  }

  _received(data) {
    if (typeof data !== "string") {
      this.buffer.came(new Uint8Array(data));
      return;
    }
    let message = null;
    try {
      message = JSON.parse(data);
    } catch {
      // Not ours: whatever it is, the packets say by themselves whether they are sound.
    }
    if (message?.pong !== undefined) this._answered(message);
    else this.buffer.said(message ?? {});
  }

  _answered({ pong, now }) {
    const here = Date.now();
    // The shortest round trip says it best; an old measurement gives way to one that is nearly as good.
    if (here - pong <= this.round + 1) {
      this.round = here - pong;
      this.ahead = now - (here + pong) / 2;
    }
  }

  _ask(socket) {
    if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify({ ping: Date.now() }));
  }

  /** A server that does not even answer is gone, whatever the system believes of the connection. */
  _watch() {
    if (performance.now() - this.heard > settings.patience) this._lost("The server does not answer");
    else this._ask(this.socket);
  }

  _wait(sentence) {
    const { pauses } = settings;
    const pause = pauses[Math.min(this.failures, pauses.length - 1)] * (0.75 + Math.random() / 2);
    this.failures += 1;
    this.timer = setTimeout(() => this._connect(), pause);
    this.buffer.trouble(`${sentence}; trying again in ${Math.max(1, Math.round(pause / 1000))} s.`);
  }
}
