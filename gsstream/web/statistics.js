// Numbers about the playing: sizes, rates and times, over the last second or so.

/** Watches a player; `update` once or twice a second, `text` for people. */
export class Statistics {
  constructor(player) {
    this.player = player;
    this.frames = [];
    this.decoding = [];
    this.last = null;
    this.drawn = 0;
    this.uploaded = 0;
    player.addEventListener("frame", () => {
      if (player.statistics.key) return;
      this.frames = [...this.frames.slice(-59), player.statistics.bytes];
      this.decoding = [...this.decoding.slice(-59), player.statistics.decode];
    });
  }

  update() {
    const now = performance.now();
    const { drawn, uploaded } = this.player.statistics;
    if (this.last) {
      const seconds = (now - this.last.now) / 1000;
      this.drawn = (drawn - this.last.drawn) / seconds;
      this.uploaded = (uploaded - this.last.uploaded) / Math.max(1, drawn - this.last.drawn);
    }
    this.last = { now, drawn, uploaded };
  }

  text() {
    const { player } = this;
    if (!player.state) return "";
    const mean = (list) => list.reduce((sum, value) => sum + value, 0) / list.length;
    const { buffer } = player;
    const loaded = `${(buffer.received / 1e6).toFixed(2)} MB loaded`;
    const lines = [
      buffer.live ? `live, frame ${player.frame}` : `frame ${player.frame} of ${player.first} to ${player.last}`,
      `${player.state.number.toLocaleString("en")} Gaussians`,
      buffer.live
        ? `${loaded}, ${player.latency?.text() ?? ""}`
        : `${loaded}, ${buffer.seconds.toFixed(1)} s ahead`,
      `sorting ${player.renderer.sorter.milliseconds.toFixed(1)} ms`,
    ];
    // Of frames that were decoded since the statistics are shown; before there is one, there is nothing to say.
    if (this.frames.length) {
      const bytes = mean(this.frames);
      const rate = (bytes * 8 * player.fps) / 1e6;
      lines.push(`${(bytes / 1000).toFixed(1)} KB a frame between key packets, ${rate.toFixed(2)} Mbit/s`);
      const where = player.link.worker ? "in a worker" : "on the page's thread";
      lines.push(`decoding ${mean(this.decoding).toFixed(1)} ms ${where}`);
    }
    if (this.drawn) {
      const uploaded = (this.uploaded / 1000).toFixed(0);
      lines.push(`${uploaded} KB to the graphics a picture, ${this.drawn.toFixed(1)} pictures/s`);
    }
    return lines.join("\n");
  }
}
