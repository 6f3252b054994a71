// A live stream in parts, from any web server: stands where a live stream has its socket (see live-socket.js).

import { FILE_HEADER, PACKET_HEADER, parseHeader } from "./container.js";
import { fileOf, refusal, settings } from "./download.js";

/** Asks for the manifest again and again, and for the parts that it did not have. */
export class LiveParts {
  constructor(buffer) {
    Object.assign(this, { buffer, ahead: 0, next: null });
  }

  start() {
    if (this.on) return;
    this.on = new AbortController();
    this.fresh = true;
    this.buffer.opened();
    this._follow(this.on);
  }

  stop() {
    this.on?.abort();
    this.on = null;
  }

  again(sentence) {
    this.stop();
    this.next = null;
    this.buffer.trouble(`${sentence}; trying again.`);
    setTimeout(() => this.start(), 1000);
  }

  sound() {}

  async _follow(on) {
    while (!on.signal.aborted) {
      let seconds = 1;
      try {
        const manifest = await this._manifest(on);
        seconds = manifest.seconds;
        for (const part of this._wanted(manifest.parts)) await this._take(part, on);
        this.buffer.said({ state: manifest.state, detail: manifest.detail });
        if (manifest.state === "ended") return;
      } catch (error) {
        if (on.signal.aborted) return;
        // Behind a part that is damaged nothing can be played before the next key packet.
        if (error.name === "PacketError") this.next = null;
        this.buffer.trouble(error.message);
      }
      await new Promise((resolve) => setTimeout(resolve, 1000 * seconds));
    }
  }

  /** What there is. Not from the browser's own cache: servers date files by the second, and this one may be younger. */
  async _manifest({ signal }) {
    const patience = AbortSignal.any([signal, AbortSignal.timeout(settings.patience)]);
    const answer = await settings.fetch(this.buffer.url, { signal: patience, cache: "no-store" });
    if (!answer.ok) throw refusal(answer, this.buffer.url);
    return answer.json();
  }

  /** The parts that follow what there is; where they do not, those since the newest key packet. */
  _wanted(parts) {
    const known = parts.findIndex((part) => part.file === this.next);
    return parts.slice(known < 0 ? parts.findLastIndex((part) => part.key) : known + 1);
  }

  async _take({ file, bytes }, on) {
    const data = await fileOf(new URL(file, this.buffer.url).href, { bytes, signal: on.signal });
    if (on.signal.aborted) return;
    if (this.fresh) this.buffer.came(data.slice(0, FILE_HEADER));
    this.fresh = false;
    for (let at = FILE_HEADER; at < data.length;) {
      const end = at + PACKET_HEADER + parseHeader(data.subarray(at), at).body;
      this.buffer.came(data.slice(at, end));
      at = end;
    }
    this.next = file;
  }
}
