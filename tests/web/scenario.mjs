// Carry out steps in a headless browser. Usage: node scenario.mjs CHROMIUM STEPS RESULTS (both JSON files)
//
// STEPS: { width, height, steps: [[name, ...arguments], ...] }. RESULTS: a list with what each
// step gave, and `messages`, the errors that the page reported.

import { readFileSync, writeFileSync } from "node:fs";

import { Browser, PLAYER } from "./browser.mjs";

const [, , chromium, from, to] = process.argv;
const plan = JSON.parse(readFileSync(from));
const browser = await Browser.start(chromium, plan);
const pause = (milliseconds) => new Promise((resolve) => setTimeout(resolve, milliseconds));

const mouse = (type, x, y, more) => browser.send("Input.dispatchMouseEvent", { type, x, y, ...more });

const actions = {
  go: (url) => browser.go(url),
  until: (expression, seconds) => browser.until(expression, seconds),
  evaluate: (expression) => browser.evaluate(expression),
  pause,
  send: (method, params) => browser.send(method, params),
  screenshot: async (path) => writeFileSync(path, await browser.screenshot()),
  key: async (key) => {
    await browser.send("Input.dispatchKeyEvent", { type: "keyDown", key, text: key.length === 1 ? key : undefined });
    await browser.send("Input.dispatchKeyEvent", { type: "keyUp", key });
  },
  // Press a button and move; `release` lets go.
  hold: async (x, y, dx, dy, button = "left") => {
    const buttons = button === "left" ? 1 : 2;
    await mouse("mousePressed", x, y, { button, buttons, clickCount: 1 });
    for (let i = 1; i <= 8; i += 1) await mouse("mouseMoved", x + (dx * i) / 8, y + (dy * i) / 8, { button, buttons });
  },
  release: (x, y, button = "left") => mouse("mouseReleased", x, y, { button, clickCount: 1 }),
  drag: async (x, y, dx, dy, button) => {
    await actions.hold(x, y, dx, dy, button);
    await actions.release(x + dx, y + dy, button);
  },
  wheel: (x, y, deltaY) => mouse("mouseWheel", x, y, { deltaX: 0, deltaY }),
  // RGBA bytes of a frame, drawn at the recording's size in exact depth order.
  picture: (frame, width, height) =>
    browser.evaluate(`(async () => {
    const player = ${PLAYER};
    player.canvas.width = ${width};
    player.canvas.height = ${height};
    player.seek(${frame});
    while (player.frame !== ${frame}) await new Promise(requestAnimationFrame);
    player.draw({ exact: true });
    const { gl } = player.renderer;
    let text = "";
    // Rows of a picture in the graphics go from the bottom to the top.
    for (let y = ${height} - 1; y >= 0; y -= 1) {
      const bytes = new Uint8Array(4 * ${width});
      gl.readPixels(0, y, ${width}, 1, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
      for (const byte of bytes) text += String.fromCharCode(byte);
    }
    return btoa(text);
  })()`),
};

const results = [];
let failure = null;
try {
  for (const [name, ...rest] of plan.steps) results.push((await actions[name](...rest)) ?? null);
} catch (error) {
  failure = `${plan.steps[results.length]?.[0]}: ${error.message}`;
}
writeFileSync(to, JSON.stringify({ results, messages: browser.messages, failure }));
await browser.stop();
