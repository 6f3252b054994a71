// Remove a folder into which another process writes for a while; print "gone" when it no longer exists.
// Used by test_browser.py: node removed_while_written.mjs FOLDER

import { existsSync } from "node:fs";
import { removed } from "./browser.mjs";

await removed(process.argv[2]);
console.log(existsSync(process.argv[2]) ? "there" : "gone");
