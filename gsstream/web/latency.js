// How late the picture is: from the moment when a packet was written to those when it came and when it was drawn.

const KEPT = 300;

/** Times of the last frames, in milliseconds of the server's clock. */
export class Latency {
  constructor() {
    this.waiting = new Map();
    this.frames = [];
  }

  /** The packet of a frame, written at `written`, came `now`. */
  written(frame, written, now) {
    this.waiting.set(frame, { frame, written, came: now - written });
    if (this.waiting.size > KEPT) this.waiting.delete(this.waiting.keys().next().value);
  }

  /**
   * The picture of a frame was drawn `now`; frames before it that were not drawn will not be. What was written before
   * the viewer came, `since`, is not late.
   */
  shown(frame, now, since) {
    const entry = this.waiting.get(frame);
    if (!entry) return;
    for (const known of this.waiting.keys()) if (known <= frame) this.waiting.delete(known);
    if (entry.written < since) return;
    this.frames = [...this.frames.slice(1 - KEPT), { ...entry, drawn: now - entry.written }];
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
