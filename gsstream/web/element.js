// <gsstream-player src="stream.json">: a player with its controls, for any page.
//
// Attributes: src, camera (id of a recorded camera), autoplay, loop ("false" plays once), speed, marks, statistics,
// controls ("false" shows none), limits ("none" lets the view leave the recorded region), eager (takes the wheel and
// fingers before a click or a tap), poster (a picture until the first one is drawn; that of a package needs none).

import { Controls } from "./controls.js";
import { PAGE, PAUSE, PLAY, STYLE } from "./look.js";
import { Player } from "./player.js";

const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4];

/** The custom element; `player` is its Player, for scripts. */
export class PlayerElement extends HTMLElement {
  static observedAttributes = ["src"];

  connectedCallback() {
    const root = this.shadowRoot ?? this.attachShadow({ mode: "open", delegatesFocus: true });
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
    this._poster(this.getAttribute("poster"));
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
      if (this.player.problem) this._tell(this.player.problem);
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
      early: this.early,
      beforeFrame: (seconds) => this.controls?.fly(seconds),
    });
    this.player.marks = this.hasAttribute("marks");
    this.controls = new Controls(canvas, this, this.player, this.hasAttribute("eager"));
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
    parts.more.onclick = () => this._more();
    parts.canvas.addEventListener("pointerdown", () => this._more(false));
    parts.poster.onload = () => {
      parts.poster.hidden = this.player.drew;
    };
    player.addEventListener("frame", () => this._progress());
    player.addEventListener("ready", () => this._fillLists());
    player.addEventListener("opened", () => this._poster(this.getAttribute("poster") ?? player.source.poster));
    player.addEventListener("drawn", () => this._drawn());
    player.addEventListener("state", () => this._progress());
    player.addEventListener("view", () => {
      parts.canvas.style.opacity = 1 - this.controls.outside;
    });
    player.addEventListener("problem", ({ detail }) => this._tell(detail));
    this.addEventListener("keydown", (event) => this._key(event));
    for (const name of ["pointermove", "pointerdown"]) this.addEventListener(name, () => this._wake());
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

  _more(on = !this.hasAttribute("more")) {
    this.toggleAttribute("more", on);
    this.parts.more.ariaExpanded = String(on);
  }

  _poster(url) {
    if (url) this.parts.poster.src = url;
  }

  /** The first picture of a stream is there. */
  _drawn() {
    this.parts.poster.hidden = true;
    this.parts.bar.hidden = this.getAttribute("controls") === "false";
    this._tell(this.player.problem ?? "");
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
    parts.camera.replaceChildren(...player.views.map((view, i) => new Option(`View ${i + 1}`)));
    parts.camera.hidden = player.views.length < 2;
    const renditions = player.source.renditions;
    parts.rendition.hidden = renditions.length < 2;
    parts.rendition.replaceChildren(...renditions.map(({ name }) => new Option(name)));
    this._progress();
  }

  _progress() {
    const { parts, player } = this;
    if (!player || player.frame === null || !player.source) return;
    parts.play.querySelector("path").setAttribute("d", player.playing ? PAUSE : PLAY);
    this.toggleAttribute("still", !player.source.live && player.buffer.last === player.first);
    parts.space.hidden = !this.hasAttribute("still");
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
