// <gsstream-player src="stream.json">: a player with its controls, for any page.
//
// Attributes: src, camera (id of a recorded camera), autoplay, loop ("false" plays once), speed, marks, statistics,
// controls ("false" shows none), limits ("none" lets the view leave the recorded region), eager (takes the wheel and
// fingers before a click or a tap), poster (a picture until the first one is drawn; that of a package needs none),
// xr ("vr" asks for a headset and says what is missing, "none" offers none).

import { Controls } from "./controls.js";
import { PAGE, PAUSE, PLAY, STYLE } from "./look.js";
import { Player } from "./player.js";
import { LOST } from "./stream-link.js";

/** What is left of a picture that is seen from as far outside of the recorded region as a hand may drag it. */
const LEFT = 0.4;
/** Radians by which an arrow turns, and the factor by which plus and minus zoom. */
const [TURN, ZOOM] = [Math.PI / 36, 1.1];
const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4];

/** The custom element; `player` is its Player, for scripts. */
export class PlayerElement extends HTMLElement {
  static observedAttributes = ["src", "camera", "speed", "loop", "controls", "marks"];

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
    else this._tell("No stream is named. Give the player an attribute src: the address of a stream.json or a .gss file.");
  }

  disconnectedCallback() {
    this._sizes?.disconnect();
    this.controls?.dispose();
    this.player?.dispose();
    this.player = null;
  }

  attributeChangedCallback(name, before, after) {
    const { player } = this;
    if (!player || before === after) return;
    if (name === "src" && after) this.load(after);
    if (name === "camera") this._look(after);
    if (name === "speed") this._speed(Number(after ?? 1));
    if (name === "loop") this._loop(after !== "false");
    if (name === "controls") this.parts.bar.hidden = after === "false" || !player.drew;
    if (name === "marks") this._marks(after !== null);
  }

  /** Open a stream. What goes wrong is said in the page; the promise resolves in any case. */
  async load(url) {
    this._tell("Loading …");
    this.parts.bar.hidden = true;
    try {
      await this.player.open(url);
      if (this.player.problem) this._tell(this.player.problem);
      // Who wants no motion begins it.
      const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
      if (this.hasAttribute("autoplay") && !still) this.player.play();
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
    parts.speed.onchange = () => this._speed(Number(parts.speed.value));
    parts.camera.onchange = () => player.look(parts.camera.selectedIndex);
    // What goes wrong is told by the event `problem`.
    parts.rendition.onchange = () => player.choose(parts.rendition.selectedIndex).catch(() => {});
    parts.loop.onclick = () => this._loop();
    parts.marks.onclick = () => this._marks();
    parts.statistics.onclick = () => this._statistics();
    parts.full.onclick = () => this._full();
    parts.headset.onclick = () => this._headset();
    this._offer();
    parts.more.onclick = () => this._more();
    parts.canvas.addEventListener("pointerdown", () => this._more(false));
    this.addEventListener("focusin", () => this._wake());
    parts.poster.onload = () => {
      parts.poster.hidden = this.player.drew;
    };
    player.addEventListener("frame", () => this._progress());
    player.addEventListener("ready", () => this._fillLists());
    player.addEventListener("opened", () => this._poster(this.getAttribute("poster") ?? player.source.poster));
    player.addEventListener("drawn", () => this._drawn());
    player.addEventListener("state", () => this._progress());
    player.addEventListener("view", () => {
      parts.canvas.style.opacity = 1 - (1 - LEFT) * this.controls.outside;
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
    this._say(this.player.playing ? "Playing" : "Paused");
  }

  /** Tell a screen reader what was done. */
  _say(text) {
    this.parts.said.textContent = text;
  }

  _speed(speed) {
    this.player.speed = speed;
    this.parts.speed.value = speed;
  }

  /** Look through a camera of the recording by its id; where there is none of this id, say so. */
  _look(id) {
    const { views } = this.player;
    const index = views.findIndex((view) => view.id === id);
    if (index >= 0) this.player.look(index);
    else if (views.length && id !== null) {
      const names = views.slice(0, 5).map((view) => view.id).join(", ");
      this.notice = `The recording has no camera "${id}". It has ${names}${views.length > 5 ? " and others" : ""}.`;
      this._tell(this.notice);
    }
    this.parts.camera.selectedIndex = Math.max(index, 0);
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
    this.style.background = "";
    this._tell(this.player.problem ?? this.notice ?? "");
  }

  async _statistics() {
    this.parts.facts.hidden = !this.parts.facts.hidden;
    this.parts.statistics.ariaPressed = String(!this.parts.facts.hidden);
    const module = await import("./statistics.js").catch(() => this._lost());
    this.facts ??= module && new module.Statistics(this.player);
    this._everySecond();
  }

  /** Say that a module did not come; a first picture that comes later takes no notice away. */
  _lost() {
    this.notice = LOST;
    this._tell(LOST);
  }

  /** A button for a headset only where there is one, or where only https is missing to whoever asks for it. */
  async _offer() {
    const wanted = this.getAttribute("xr");
    const found = await globalThis.navigator.xr?.isSessionSupported("immersive-vr").catch(() => false);
    this.parts.headset.hidden = wanted === "none" || !(found || (wanted === "vr" && !isSecureContext));
  }

  async _headset() {
    const module = await import("./xr.js").catch(() => this._lost());
    this.headset = module && new module.Headset(this.player);
    await this.headset?.enter().catch((error) => this._tell(error.message));
  }

  _full() {
    if (document.fullscreenElement) document.exitFullscreen();
    else this.requestFullscreen?.().catch(() => this._tell("This browser shows no part of a page in full screen."));
  }

  _fillLists() {
    const { parts, player } = this;
    parts.camera.replaceChildren(...player.views.map((view, i) => new Option(`View ${i + 1}`)));
    parts.camera.hidden = player.views.length < 2;
    parts.camera.selectedIndex = player.views.findIndex(({ id }) => id === player.view.id);
    this.notice = null;
    if (this.hasAttribute("camera")) this._look(this.getAttribute("camera"));
    const renditions = player.source.renditions;
    parts.rendition.hidden = renditions.length < 2;
    parts.rendition.replaceChildren(...renditions.map(({ name }) => new Option(name)));
    this._progress();
  }

  _progress() {
    const { parts, player } = this;
    if (!player || player.frame === null || !player.source) return;
    parts.play.querySelector("path").setAttribute("d", player.playing ? PAUSE : PLAY);
    parts.play.ariaLabel = player.playing ? "Pause" : "Play";
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
    parts.seek.ariaValueText = `${seconds(player.frame)} of ${seconds(player.last)} seconds`;
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
    const [part] = event.composedPath();
    if (event.ctrlKey || event.metaKey || event.altKey || part instanceof HTMLSelectElement) return;
    // A control that has the focus is pressed, or moved, by the keys that do so everywhere.
    if (part instanceof HTMLButtonElement && [" ", "Enter"].includes(event.key)) return;
    if (part instanceof HTMLInputElement && /^(Arrow|Home|End|Page)/.test(event.key)) return;
    const { player, controls } = this;
    const faster = (step) => {
      const at = SPEEDS.indexOf(player.speed) + step;
      this._speed(SPEEDS[Math.max(0, Math.min(SPEEDS.length - 1, at))] ?? 1);
      this._say(`Speed ${player.speed}`);
    };
    const step = (way) => {
      player.pause();
      player.seek(player.frame + way);
      this._say(`Frame ${player.frame + way}`);
    };
    const actions = {
      " ": () => this._toggle(),
      ArrowRight: () => controls.turn(TURN, 0),
      ArrowLeft: () => controls.turn(-TURN, 0),
      ArrowUp: () => controls.turn(0, -TURN),
      ArrowDown: () => controls.turn(0, TURN),
      "+": () => controls.turn(0, 0, 1 / ZOOM),
      "-": () => controls.turn(0, 0, ZOOM),
      ".": () => step(1),
      ",": () => step(-1),
      ">": () => faster(1),
      "<": () => faster(-1),
      Home: () => player.seek(player.first),
      End: () => player.seek(player.last),
      g: () => this._marks(),
      i: () => this._statistics(),
      f: () => this._full(),
      l: () => this._loop(),
      r: () => player.look(Math.max(0, this.parts.camera.selectedIndex)),
    };
    if (this.hasAttribute("more")) {
      actions.Escape = () => {
        this._more(false);
        this.parts.more.focus();
      };
    }
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
