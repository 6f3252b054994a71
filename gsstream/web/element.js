// <gsstream-player src="stream.json">: a player with its controls, for any page.
//
// Attributes: src, camera (id of a recorded camera), autoplay, loop ("false" plays once), speed, marks, statistics,
// controls ("false" shows none), limits ("none" lets the view leave the recorded region).

import { Controls } from "./controls.js";
import { Player } from "./player.js";

const STYLE = `
:host { display: block; position: relative; aspect-ratio: 16 / 9; background: #111; color: #eee; overflow: hidden;
  font: 13px/1.4 system-ui, sans-serif; }
canvas { width: 100%; height: 100%; display: block; outline: none; cursor: grab; }
canvas:active { cursor: grabbing; }
.bar { position: absolute; inset: auto 0 0 0; display: flex; gap: 8px; align-items: center; padding: 24px 12px 8px;
  background: linear-gradient(transparent, #000b); transition: opacity .25s; }
:host([idle]) .bar { opacity: 0; }
button, select { background: #fff2; color: inherit; border: 0; border-radius: 4px; padding: 4px 8px; font: inherit;
  cursor: pointer; }
button:hover, select:hover { background: #fff4; }
button[aria-pressed=true] { background: #e8a33d; color: #111; }
select option { color: #111; }
input { flex: 1; min-width: 60px; accent-color: #e8a33d; }
.time { font-variant-numeric: tabular-nums; white-space: nowrap; }
.message, .facts { position: absolute; left: 12px; top: 12px; max-width: calc(100% - 24px); padding: 6px 10px;
  border-radius: 4px;
  background: #000a; white-space: pre-line; pointer-events: none; }
.message { inset: 0; margin: auto; width: fit-content; height: fit-content; text-align: center; }
.facts { font-variant-numeric: tabular-nums; }
[hidden] { display: none; }
@media (max-width: 560px) { .wide { display: none; } }`;

const PAGE = `
<canvas tabindex="0" aria-label="Stream of 3D Gaussians: drag to turn, scroll to zoom"></canvas>
<div class="facts" hidden></div>
<div class="message" role="status"></div>
<div class="bar">
  <button class="play" title="Play or pause (space)">&#9654;</button>
  <input class="seek" type="range" min="0" max="1" value="0" step="1" aria-label="frame">
  <span class="time"></span>
  <select class="speed wide" title="Speed (+ and -)"></select>
  <select class="camera" title="Viewpoint (1 to 9)"></select>
  <button class="loop wide" title="Begin again at the end (l)">loop</button>
  <select class="rendition wide" title="Rendition" hidden></select>
  <button class="marks wide" title="Mark what the frame changed (g)">changes</button>
  <button class="statistics wide" title="Statistics (i)">i</button>
  <button class="full wide" title="Full screen (f)">full screen</button>
</div>`;

const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4];

/** The custom element; `player` is its Player, for scripts. */
export class PlayerElement extends HTMLElement {
  static observedAttributes = ["src"];

  connectedCallback() {
    const root = this.shadowRoot ?? this.attachShadow({ mode: "open" });
    root.innerHTML = `<style>${STYLE}</style>${PAGE}`;
    const named = [...root.querySelectorAll("[class]")].map((part) => [part.classList[0], part]);
    this.parts = { canvas: root.querySelector("canvas"), ...Object.fromEntries(named) };
    this.parts.bar.hidden = true;
    try {
      this._makePlayer();
    } catch (error) {
      this._tell(error.message);
      return;
    }
    this._listen();
    if (this.hasAttribute("src")) this.load(this.getAttribute("src"));
  }

  disconnectedCallback() {
    this._sizes?.disconnect();
    this.controls?.dispose();
    this.player?.dispose();
    this.player = null;
  }

  attributeChangedCallback(name, before, after) {
    if (this.player && before !== after && after) this.load(after);
  }

  /** Open a stream. What goes wrong is said in the page; the promise resolves in any case. */
  async load(url) {
    this._tell("Loading …");
    this.parts.bar.hidden = true;
    try {
      await this.player.open(url);
      this._fillLists();
      this._tell(this.player.problem ?? "");
      if (this.hasAttribute("autoplay")) this.player.play();
    } catch (error) {
      if (error.name !== "AbortError") this._tell(error.message);
    }
  }

  _makePlayer() {
    const { canvas } = this.parts;
    this.player = new Player(canvas, {
      camera: this.getAttribute("camera"),
      loop: this.getAttribute("loop") !== "false",
      speed: Number(this.getAttribute("speed") ?? 1),
      limits: this.getAttribute("limits") !== "none",
      beforeFrame: (seconds) => this.controls?.fly(seconds),
    });
    this.player.marks = this.hasAttribute("marks");
    this.controls = new Controls(canvas, this, this.player);
    this._sizes = new ResizeObserver(() => this._fit());
    this._sizes.observe(canvas);
    this._fit();
  }

  /** A pixel of the canvas for each of the screen, to a limit that phones bear. */
  _fit() {
    const { canvas } = this.parts;
    const ratio = Math.min(globalThis.devicePixelRatio || 1, 2);
    const width = Math.max(1, Math.round(canvas.clientWidth * ratio));
    const height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    if (canvas.width === width && canvas.height === height) return;
    canvas.width = width;
    canvas.height = height;
    this.player.invalidate();
  }

  _listen() {
    const { parts, player } = this;
    parts.play.onclick = () => this._toggle();
    parts.seek.oninput = () => player.seek(Number(parts.seek.value));
    parts.speed.replaceChildren(
      ...SPEEDS.map((speed) => new Option(`${speed}×`, speed, false, speed === player.speed)),
    );
    parts.speed.onchange = () => {
      player.speed = Number(parts.speed.value);
    };
    parts.camera.onchange = () => player.look(parts.camera.selectedIndex);
    // What goes wrong is told by the event `problem`.
    parts.rendition.onchange = () => player.choose(parts.rendition.selectedIndex).catch(() => {});
    parts.loop.onclick = () => this._loop();
    parts.marks.onclick = () => this._marks();
    parts.statistics.onclick = () => this._statistics();
    parts.full.onclick = () => this._full();
    player.addEventListener("frame", () => this._progress());
    player.addEventListener("ready", () => this._fillLists());
    player.addEventListener("state", () => this._progress());
    player.addEventListener("view", () => {
      parts.canvas.style.opacity = 1 - this.controls.outside;
    });
    player.addEventListener("problem", ({ detail }) => this._tell(detail));
    this.addEventListener("keydown", (event) => this._key(event));
    this.addEventListener("pointermove", () => this._wake());
    this._clock = setInterval(() => this._everySecond(), 500);
    if (this.hasAttribute("statistics")) this._statistics();
    this._marks(player.marks);
    this._loop(player.loop);
    this._wake();
  }

  _toggle() {
    if (this.player.playing) this.player.pause();
    else {
      this._tell("");
      this.player.play();
    }
  }

  _marks(on = !this.player.marks) {
    this.player.marks = on;
    this.parts.marks.ariaPressed = String(on);
  }

  _loop(on = !this.player.loop) {
    this.player.loop = on;
    this.parts.loop.ariaPressed = String(on);
  }

  async _statistics() {
    this.parts.facts.hidden = !this.parts.facts.hidden;
    this.parts.statistics.ariaPressed = String(!this.parts.facts.hidden);
    const { Statistics } = await import("./statistics.js");
    this.facts ??= new Statistics(this.player);
    this._everySecond();
  }

  _full() {
    if (document.fullscreenElement) document.exitFullscreen();
    else this.requestFullscreen?.().catch(() => this._tell("This browser shows no part of a page in full screen."));
  }

  _fillLists() {
    const { parts, player } = this;
    parts.bar.hidden = this.getAttribute("controls") === "false";
    parts.camera.replaceChildren(
      ...player.views.map((view) => new Option(view.split === "test" ? `${view.id} (held out)` : view.id)),
    );
    const renditions = player.source.renditions;
    parts.rendition.hidden = renditions.length < 2;
    parts.rendition.replaceChildren(...renditions.map(({ name }) => new Option(name)));
    this._progress();
  }

  _progress() {
    const { parts, player } = this;
    if (!player || player.frame === null) return;
    parts.play.textContent = player.playing ? "\u275A\u275A" : "\u25B6";
    parts.seek.min = player.first;
    parts.seek.max = Math.max(player.last, player.first + 1);
    parts.seek.value = player.frame;
    parts.seek.hidden = parts.speed.hidden = parts.loop.hidden = Boolean(player.source.live);
    if (player.source.live) {
      parts.time.textContent = `live, frame ${player.frame}`;
      return;
    }
    const seconds = (frame) => ((frame - player.first) / player.fps).toFixed(1);
    parts.time.textContent = `${seconds(player.frame)} / ${seconds(player.last)} s`;
  }

  _everySecond() {
    if (!this.player) {
      clearInterval(this._clock);
      return;
    }
    this.facts?.update();
    if (this.facts && !this.parts.facts.hidden) this.parts.facts.textContent = this.facts.text();
    this._progress();
  }

  _wake() {
    this.removeAttribute("idle");
    clearTimeout(this._idle);
    this._idle = setTimeout(() => this.player?.playing && this.setAttribute("idle", ""), 3000);
  }

  _key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || event.composedPath()[0] instanceof HTMLSelectElement) return;
    const { player } = this;
    const speed = (step) => {
      player.speed = SPEEDS[Math.max(0, Math.min(SPEEDS.length - 1, SPEEDS.indexOf(player.speed) + step))] ?? 1;
      this.parts.speed.value = player.speed;
    };
    const step = (way) => {
      player.pause();
      player.seek(player.frame + way);
    };
    const actions = {
      " ": () => this._toggle(),
      ArrowRight: () => step(1),
      ArrowLeft: () => step(-1),
      Home: () => player.seek(player.first),
      End: () => player.seek(player.last),
      g: () => this._marks(),
      i: () => this._statistics(),
      f: () => this._full(),
      "+": () => speed(1),
      "-": () => speed(-1),
      l: () => this._loop(),
      r: () => player.look(Math.max(0, this.parts.camera.selectedIndex)),
    };
    const number = Number(event.key) - 1;
    if (number >= 0 && number < player.views.length && event.key !== " ") {
      this.parts.camera.selectedIndex = number;
      player.look(number);
    } else if (actions[event.key]) {
      actions[event.key]();
    } else {
      return;
    }
    event.preventDefault();
    this._wake();
  }

  _tell(text) {
    this.parts.message.textContent = text;
    this.parts.message.hidden = !text;
  }
}

customElements.define("gsstream-player", PlayerElement);
