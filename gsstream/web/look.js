// What the player looks like: its style and its parts. The bar keeps one line from 280 pixels on.

const icon = (path) => `<svg viewBox="0 0 24 24" aria-hidden="true"><path d="${path}"/></svg>`;

/** Outlines of icons that change. */
export const PLAY = "M8 5v14l11-7z";
export const PAUSE = "M6 5h4v14H6zM14 5h4v14h-4z";
const REPEAT = "M7 7h10v3l4-4-4-4v3H5v6h2zM17 17H7v-3l-4 4 4 4v-3h12v-6h-2z";
const CHANGES = "M12 3a9 9 0 1 0 0 18 9 9 0 0 0 0-18zm0 2v14a7 7 0 0 1 0-14z";
const DETAILS = "M12 3a9 9 0 1 0 0 18 9 9 0 0 0 0-18zm0 2a7 7 0 1 1 0 14 7 7 0 0 1 0-14zm-1 2h2v2h-2zm0 4h2v6h-2z";
const FULL = "M4 4h6v2H6v4H4zM14 4h6v6h-2V6h-4zM4 14h2v4h4v2H4zM18 14h2v6h-6v-2h4z";
const HEADSET = "M3 7h18v10h-6l-3-3-3 3H3zM7 10v4h3v-4zM14 10v4h3v-4z";
const MORE = "M4 10h4v4H4zM10 10h4v4h-4zM16 10h4v4h-4z";

export const STYLE = `
:host { display: block; position: relative; aspect-ratio: 16 / 9; background: #111; color: #eee; overflow: hidden;
  font: 14px/1.3 system-ui, sans-serif; }
[hidden], :host([still]) .moving, label:has([hidden]) { display: none !important; }
canvas { width: 100%; height: 100%; display: block; cursor: grab; }
canvas:focus-visible { outline-offset: -4px; }
canvas:active { cursor: grabbing; }
.poster, .over { position: absolute; inset: 0; width: 100%; height: 100%; }
.poster { object-fit: cover; }
.poster, .over { pointer-events: none; }
.over { container-type: size; }
.over > * { --side: 44px; }
.bar { position: absolute; inset: auto 0 0 0; display: flex; gap: 4px; align-items: center; padding: 16px 8px 4px;
  background: linear-gradient(transparent, #000b); transition: opacity .25s; }
.bar, .bar * { pointer-events: auto; }
:host([idle]) .bar:not(:has(:focus-visible)) { opacity: 0; }
:host([idle]) .bar:not(:has(:focus-visible)), :host([idle]) .bar:not(:has(:focus-visible)) * { pointer-events: none; }
button, select, input, label { box-sizing: border-box; height: var(--side); min-width: var(--side); margin: 0;
  font: inherit; color: inherit; }
button, select { flex: none; border: 0; border-radius: 6px; padding: 0 8px; background: #222d; cursor: pointer; }
button:hover, select:hover { background: #444d; }
button[aria-pressed=true], button[aria-expanded=true] { color: #f2b557; }
:focus-visible { outline: 3px solid #f2b557; box-shadow: 0 0 0 5px #000; }
select option { color: #111; }
svg { width: 20px; height: 20px; fill: currentColor; display: block; flex: none; margin: auto; }
.seek { flex: 1; min-width: 60px; accent-color: #e8a33d; }
.space { flex: 1; }
.time { display: none; padding: 4px 8px; border-radius: 6px; background: #222d;
  font-variant-numeric: tabular-nums; white-space: nowrap; }
.camera { max-width: 88px; }
.panel { display: none; position: absolute; right: 8px; bottom: calc(100% - 16px); flex-wrap: wrap; gap: 4px;
  box-sizing: border-box; width: min(100% - 16px, 300px); max-height: calc(100cqh - var(--side) - 8px); overflow: auto;
  padding: 4px; border-radius: 8px; background: #111e; }
:host([more]) .panel { display: flex; }
.panel > * { display: flex; flex-direction: column; align-items: center; justify-content: center;
  flex: 1 30%; min-width: 0; height: calc(var(--side) + 2px); border-radius: 6px; padding: 0 4px; background: #333; }
.panel span { font-size: 12px; white-space: nowrap; }
.panel svg { margin: 0; }
.panel label { position: relative; justify-content: end; padding-bottom: 4px; }
.panel select { position: absolute; inset: 0; width: 100%; height: 100%; padding: 0 0 18px; background: none;
  text-align: center; text-align-last: center; }
.message, .facts { position: absolute; left: 8px; top: 8px; max-width: calc(100% - 40px); padding: 6px 10px;
  border-radius: 6px; background: #000d; white-space: pre-line; }
.message { inset: 0; margin: auto; width: fit-content; height: fit-content; text-align: center; }
.facts { font-variant-numeric: tabular-nums; max-width: calc(100% - 16px); box-sizing: border-box; font-size: 13px; }
.said { position: absolute; width: 1px; height: 1px; overflow: hidden; clip-path: inset(50%); }
@media (prefers-reduced-motion: reduce) { .bar { transition: none; } }
@container (min-width: 480px) {
  .time { display: block; }
  .camera { max-width: 140px; }
}
@container (min-width: 1100px) {
  .more { display: none; }
  .panel, :host([more]) .panel { display: contents; }
  .panel > * { flex-direction: row; flex: none; gap: 6px; height: var(--side); padding: 0 10px; }
  .panel span { font-size: inherit; }
  .panel label { padding: 0 0 0 10px; }
  .panel select { position: static; width: auto; padding: 0 4px; text-align-last: auto; }
}
@container (min-width: 1900px) {
  .over > * { --side: 54px; font-size: 18px; }
  svg { width: 26px; height: 26px; }
}`;

export const PAGE = `
<canvas tabindex="0" role="application" aria-label="Scene: arrows turn it, plus and minus zoom, space plays"></canvas>
<img class="poster" alt="" hidden>
<div class="over">
<div class="facts" hidden></div>
<div class="message" role="status"></div>
<div class="said" role="status"></div>
<div class="bar" role="group" aria-label="Player">
  <button class="play moving" title="Play or pause (space)" aria-label="Play">${icon(PLAY)}</button>
  <input class="seek moving" type="range" min="0" max="1" value="0" step="1" aria-label="Time">
  <span class="time moving"></span>
  <span class="space" hidden></span>
  <select class="camera" title="Viewpoint (1 to 9)" aria-label="Viewpoint"></select>
  <div class="panel">
    <label class="moving" title="Speed (&lt; and &gt;)"><span>Speed</span><select class="speed"></select></label>
    <button class="loop moving" title="Begin again at the end (l)">${icon(REPEAT)}<span>Repeat</span></button>
    <label title="Other streams of the recording"><span>Quality</span><select class="rendition" hidden></select></label>
    <button class="marks moving" title="Mark what the frame changed (g)">${icon(CHANGES)}<span>Changes</span></button>
    <button class="statistics" title="Sizes and rates (i)">${icon(DETAILS)}<span>Details</span></button>
    <button class="headset" title="Look with a headset" hidden>${icon(HEADSET)}<span>Headset</span></button>
    <button class="full" title="Full screen (f)">${icon(FULL)}<span>Full screen</span></button>
  </div>
  <button class="more" title="More (Escape closes)" aria-label="More" aria-expanded="false">${icon(MORE)}</button>
</div>
</div>`;
