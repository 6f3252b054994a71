// A headless browser that does what it is told, one step at a time. Usage: node interactive.mjs CHROMIUM WIDTH HEIGHT
//
// Each line of standard input is a step, [name, ...arguments] as JSON; each line of output is what it gave:
// { value } or { error }, with `messages`, the errors that the page reported meanwhile.

import { writeFileSync } from "node:fs";
import { createInterface } from "node:readline";

import { Browser } from "./browser.mjs";

const [, , chromium, width, height] = process.argv;
const browser = await Browser.start(chromium, { width: Number(width), height: Number(height) });
const actions = {
  go: (url) => browser.go(url),
  until: (expression, seconds) => browser.until(expression, seconds),
  send: (method, params) => browser.send(method, params),
  evaluate: (expression) => browser.evaluate(expression),
  screenshot: async (path) => writeFileSync(path, await browser.screenshot()),
};

for await (const line of createInterface({ input: process.stdin })) {
  const [name, ...rest] = JSON.parse(line);
  const answer = {};
  try {
    answer.value = (await actions[name](...rest)) ?? null;
  } catch (error) {
    answer.error = error.message;
  }
  answer.messages = browser.messages.splice(0);
  console.log(JSON.stringify(answer));
}
await browser.stop();
