// A Chromium without a window, driven through its debugging pipe: no package is needed for it.

import { spawn } from "node:child_process";
import { mkdtempSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";

const FLAGS = [
  "--headless",
  "--no-sandbox",
  "--use-gl=angle",
  "--use-angle=swiftshader",
  "--enable-unsafe-swiftshader",
  "--ignore-gpu-blocklist",
  "--remote-debugging-pipe",
  "--no-first-run",
  "--disable-dev-shm-usage",
  "--hide-scrollbars",
];

/** What pages and the players in them show, frames with the page that holds them. */
const SHOWN = `(function shown(at) {
  const players = [...at.querySelectorAll("gsstream-player")].map(({ shadowRoot }) => {
    return shadowRoot ? (shadowRoot.querySelector(".message")?.textContent ?? "nothing") : "no player yet";
  });
  const frames = [...at.querySelectorAll("iframe")].map(({ contentDocument }) => contentDocument && shown(contentDocument));
  return [at.URL + ' (' + at.readyState + ') shows: ' + players.join(" | "), ...frames].join("; ");
})(document)`;

/** One browser with one page. */
export class Browser {
  /** Start the program at `path`; `flags` are added to those it always gets. */
  static async start(path, { width = 960, height = 600, flags = [] } = {}) {
    const browser = new Browser();
    browser.profile = mkdtempSync(join(tmpdir(), "chromium-"));
    browser.child = spawn(path, [...FLAGS, ...flags, `--user-data-dir=${browser.profile}`, "about:blank"], {
      stdio: ["ignore", "ignore", "ignore", "pipe", "pipe"],
      // A process group of its own, so that `stop` can end its children with it.
      detached: true,
    });
    browser.last = 0;
    browser.waiting = new Map();
    browser.messages = [];
    browser._listen();
    const { targetInfos } = await browser.send("Target.getTargets");
    const { targetId } = targetInfos.find(({ type }) => type === "page");
    ({ sessionId: browser.session } = await browser.send("Target.attachToTarget", { targetId, flatten: true }));
    await browser.send("Page.enable");
    await browser.send("Runtime.enable");
    await browser.send("Network.enable");
    await browser.send("Emulation.setDeviceMetricsOverride", { width, height, deviceScaleFactor: 1, mobile: false });
    return browser;
  }

  _listen() {
    let rest = "";
    this.child.stdio[4].setEncoding("utf8").on("data", (text) => {
      const parts = (rest + text).split("\0");
      rest = parts.pop();
      for (const part of parts) this._received(JSON.parse(part));
    });
    this.child.on("exit", (code) => {
      for (const { reject } of this.waiting.values()) reject(new Error(`the browser ended with code ${code}`));
    });
  }

  _received(message) {
    const { id, method, params } = message;
    if (this.waiting.has(id)) {
      const { resolve, reject } = this.waiting.get(id);
      this.waiting.delete(id);
      if (message.error) reject(new Error(message.error.message));
      else resolve(message.result);
    } else if (method === "Runtime.consoleAPICalled" && params.type === "error") {
      this.messages.push(params.args.map((arg) => arg.value ?? arg.description).join(" "));
    } else if (method === "Runtime.exceptionThrown") {
      this.messages.push(params.exceptionDetails.exception?.description ?? params.exceptionDetails.text);
    }
  }

  send(method, params = {}) {
    this.last += 1;
    const id = this.last;
    const message = { id, method, params, ...(this.session ? { sessionId: this.session } : {}) };
    this.child.stdio[3].write(`${JSON.stringify(message)}\0`);
    return new Promise((resolve, reject) => this.waiting.set(id, { resolve, reject }));
  }

  go(url) {
    return this.send("Page.navigate", { url });
  }

  /** What an expression (a promise is awaited) comes to in the page. */
  async evaluate(expression) {
    const { result, exceptionDetails } = await this.send("Runtime.evaluate", {
      expression,
      awaitPromise: true,
      returnByValue: true,
    });
    if (exceptionDetails) throw new Error(exceptionDetails.exception?.description ?? exceptionDetails.text);
    return result.value;
  }

  /** Wait until an expression is true in the page. */
  async until(expression, seconds = 60) {
    const end = Date.now() + 1000 * seconds;
    while (Date.now() < end) {
      if (await this.evaluate(`Boolean(${expression})`)) return;
      await new Promise((resolve) => setTimeout(resolve, 50));
    }
    const said = this.messages.join("; ");
    throw new Error(`after ${seconds} s still not: ${expression}; the page said: ${said}; ${await this.evaluate(SHOWN)}`);
  }

  async screenshot() {
    const { data } = await this.send("Page.captureScreenshot", { format: "png" });
    return Buffer.from(data, "base64");
  }

  async stop() {
    const ended = new Promise((resolve) => this.child.on("exit", resolve));
    // A polite end takes seconds, and nothing of the profile is kept. The whole group is killed, because the browser's
    // own children outlive it and write to the profile.
    process.kill(-this.child.pid, "SIGKILL");
    await ended;
    await removed(this.profile);
  }
}

/**
 * Remove a folder to which dying processes may still write.
 *
 * `maxRetries` of rmSync does not do this: it tries the removal of a folder again without emptying it again.
 */
export async function removed(folder, seconds = 10) {
  const end = Date.now() + 1000 * seconds;
  for (;;) {
    try {
      return rmSync(folder, { recursive: true, force: true });
    } catch (error) {
      if (error.code !== "ENOTEMPTY" || Date.now() > end) throw error;
      await new Promise((resolve) => setTimeout(resolve, 50));
    }
  }
}

/** JavaScript that stands for the player of the page. */
export const PLAYER = "document.querySelector('gsstream-player').player";
