// What a page's own thread does while a stream plays and seeks, from Chromium's trace.
//
// Usage: node page_work.mjs CHROMIUM URL [SECONDS] -> JSON on standard output: milliseconds from the beginning of the
// page to its first picture and to the first whole one (a first layer is drawn before); whether the stream is decoded in
// a worker; seconds of processor time of the whole browser until then; and, while it plays for SECONDS and then seeks eight times: pictures drawn, frames shown,
// the longest task of the page's thread by the clock (`wall`) and by its processor time (`cpu`), tasks longer than 16 ms
// of processor time, and processor time a picture.

import { readFileSync, readdirSync } from "node:fs";

import { Browser, PLAYER } from "./browser.mjs";

const [, , chromium, url, seconds = "4"] = process.argv;
const CATEGORIES = ["toplevel", "disabled-by-default-devtools.timeline", "__metadata"];
const FIRST = `setInterval(() => {
  const player = document.querySelector("gsstream-player")?.player;
  const { drawn, early } = player?.statistics ?? {};
  if (drawn || early) window.first ??= performance.now();
  if (drawn) window.whole ??= performance.now();
}, 4)`;

const browser = await Browser.start(chromium, { width: 320, height: 180 });
const pause = (milliseconds) => new Promise((resolve) => setTimeout(resolve, milliseconds));
const events = [];
const received = browser._received.bind(browser);
let complete = () => {};
browser._received = (message) => {
  if (message.method === "Tracing.dataCollected") events.push(...message.params.value);
  else if (message.method === "Tracing.tracingComplete") complete();
  else received(message);
};

/** Seconds of processor time that all processes of the browser have taken. */
function used() {
  const lines = readdirSync("/proc").filter(Number).flatMap((name) => {
    try {
      return [readFileSync(`/proc/${name}/stat`, "utf8").replace(/^.*\) /, "").split(" ")];
    } catch {
      return []; // It has ended meanwhile.
    }
  });
  // Process group, and hundredths of a second in its own code and in the system's.
  const own = lines.filter((fields) => Number(fields[2]) === browser.child.pid);
  return own.reduce((sum, fields) => sum + (Number(fields[11]) + Number(fields[12])) / 100, 0);
}

await browser.send("Page.addScriptToEvaluateOnNewDocument", { source: FIRST });
await pause(500);
const before = used();
await browser.go(url);
await browser.until("window.whole", 120);
const processor = used() - before;
const [first, whole] = await browser.evaluate("[window.first, window.whole]");
const decoded = await browser.evaluate(`${PLAYER}.link?.worker ? "in a worker" : "on the page's thread"`);
await pause(500);
await browser.send("Tracing.start", { transferMode: "ReportEvents", traceConfig: { includedCategories: CATEGORIES } });
await browser.evaluate(`window.frames_ = 0; ${PLAYER}.addEventListener("frame", () => { frames_ += 1; });
  ${PLAYER}.statistics.drawn = 0; ${PLAYER}.play()`);
await pause(1000 * Number(seconds));
await browser.evaluate(`${PLAYER}.pause()`);
const last = await browser.evaluate(`${PLAYER}.last`);
for (const part of [0.5, 0.1, 0.9, 0, 0.7, 1, 0.3, 0.65]) {
  const frame = Math.round(part * last);
  await browser.evaluate(`${PLAYER}.seek(${frame})`);
  await browser.until(`${PLAYER}.frame === ${frame}`);
}
await pause(500);
const [pictures, frames] = await browser.evaluate(`[${PLAYER}.statistics.drawn, frames_]`);
const ended = new Promise((resolve) => {
  complete = resolve;
});
await browser.send("Tracing.end");
await ended;
await browser.stop();

const names = events.filter(({ name, args }) => name === "thread_name" && args.name === "CrRendererMain");
const tasksOf = ({ pid, tid }) =>
  events.filter((event) => event.pid === pid && event.tid === tid && event.ph === "X" && /RunTask$/.test(event.name));
// Of several processes that of the page is the one that works most.
const sum = (tasks) => tasks.reduce((total, { tdur = 0 }) => total + tdur, 0);
const all = names.map(tasksOf).sort((a, b) => sum(b) - sum(a))[0];
const name = all[0].name;
const tasks = all.filter((event) => event.name === name);
const most = (field) => Math.max(...tasks.map((task) => task[field] ?? 0)) / 1000;
const rounded = (value) => Math.round(100 * value) / 100;
console.log(
  JSON.stringify({
    first: Math.round(first),
    whole: Math.round(whole),
    processor: rounded(processor),
    decoded,
    pictures,
    frames,
    longest: { wall: rounded(most("dur")), cpu: rounded(most("tdur")) },
    long: tasks.filter(({ tdur = 0 }) => tdur > 16000).length,
    perPicture: rounded(sum(tasks) / 1000 / pictures),
  }),
);
