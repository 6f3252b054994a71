// How late the picture is: from the moment when a packet was written to those when it came and when it was drawn.

const KEPT = 300;

/** Times of the last frames, in milliseconds of the server's clock. */
export class Latency {
  constructor() {
    this.waiting = new Map();
    this.frames = [];
    this.ahead = this.joined = 0;
  }

  /**
   * The packet of a frame, written at `written`, came at `came`, by the server's clock, which is `ahead` of this one. What
   * was written before the viewer came, `joined`, is not late.
   */
  written({ frame, written, came, ahead, joined }) {
    Object.assign(this, { ahead, joined });
    this.waiting.set(frame, { frame, written, came: came - written });
    if (this.waiting.size > KEPT) this.waiting.delete(this.waiting.keys().next().value);
  }

  /** The picture of a frame was drawn `now`; frames before it that were not drawn will not be. */
  shown(frame, now) {
    const entry = this.waiting.get(frame);
    if (!entry) return;
    for (const known of this.waiting.keys()) if (known <= frame) this.waiting.delete(known);
    if (entry.written < this.joined) return;
    this.frames = [...this.frames.slice(1 - KEPT), { ...entry, drawn: now + this.ahead - entry.written }];
  }

  text() {
    if (!this.frames.length) return "latency not known yet";
    const sorted = (name) => this.frames.map((entry) => entry[name]).sort((a, b) => a - b);
    const came = sorted("came");
    const drawn = sorted("drawn");
    const middle = drawn.length >> 1;
    const worst = drawn[drawn.length - 1];
    return (
      `written to drawn ${drawn[middle].toFixed(0)} ms (worst ${worst.toFixed(0)}), ` +
      `to received ${came[middle].toFixed(0)} ms`
    );
  }
}
