// What the tests compare states by.

import { ATTRIBUTES } from "../../gsstream/web/limits.js";

/** The bytes of all attributes in their order: equal for equal states. */
export function sceneBytes(state) {
  return Buffer.concat(
    ATTRIBUTES.map((name) => {
      const { buffer, byteOffset, byteLength } = state.scene[name];
      return new Uint8Array(buffer, byteOffset, byteLength);
    }),
  );
}
