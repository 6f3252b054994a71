// A stream as an entity of a PlayCanvas scene. The page's import map, or a bundler, says where "playcanvas" is; the other
// modules are those of a package, in the folder "site" beside this file. PlayCanvas draws, sorts and blends; the attributes
// lie in float32 textures, from which the engine fills its own. WebGL2 only: the code that reads them is GLSL.

import {
  BoundingBox,
  Entity,
  FILTER_NEAREST,
  GSPLATDATA_LARGE,
  GSplatContainer,
  GSplatFormat,
  Mat4,
  PIXELFORMAT_RGBA32F,
  Quat,
  Texture,
  Vec3,
  WORKBUFFER_UPDATE_ALWAYS,
} from "playcanvas";

import { cameraOf } from "./site/camera.js";
import { Player } from "./site/player.js";
import { colourFunction } from "./site/shaders.js";
import { GEOMETRY_TEXELS, colourTexels, shiftOf } from "./site/texels.js";

/** Settings of `app.scene.gsplat` with which pictures look as these scenes were trained. */
export const AS_TRAINED = {
  dataFormat: GSPLATDATA_LARGE,
  alphaClipForward: 1 / 255,
  minPixelSize: 0,
  minContribution: 0,
};
/** Variance of every footprint in the training, and what PlayCanvas gives it, pixels squared (0.3 of halves of pixels). */
const [BLUR, GIVEN] = [0.3, 0.075];

/** GLSL with which the engine reads splat `splat.index`: what lies in the slot of that number. */
function reading(degree) {
  const texels = colourTexels(degree);
  const [lines, colourLines] = [GEOMETRY_TEXELS, texels].map(shiftOf);
  return `
uniform highp sampler2D gsstreamGeometry;
uniform highp sampler2D gsstreamColours;
uniform float gsstreamBlur;  // variance that is added at distance 1
${colourFunction(degree)}
vec4 stored(int part) {
  int slot = int(splat.index);
  return texelFetch(gsstreamGeometry, ivec2((slot & ${2 ** lines - 1}) * ${GEOMETRY_TEXELS} + part, slot >> ${lines}), 0);
}
vec3 getCenter() {
  return stored(0).xyz;
}
vec4 getRotation() {
  return normalize(stored(1));
}
vec3 getScale() {
  float away = (matrix_view * matrix_model * vec4(getCenter(), 1.0)).z / model_scale.x;
  return sqrt(exp(2.0 * stored(2).xyz) + gsstreamBlur * away * away);
}
vec4 getColor() {
  vec4 first = stored(0);
  vec3 eye = inverse(matrix_view * matrix_model)[3].xyz;
  int slot = int(splat.index);
  int at = (slot & ${2 ** colourLines - 1}) * ${texels};
  vec3 colour = seenFrom${degree}(gsstreamColours, first.xyz - eye, at, slot >> ${colourLines});
  return vec4(colour, 1.0 / (1.0 + exp(-first.w)));
}`;
}

/** What a player asks of its renderer, and the resource of a gsplat component that it fills. */
class StreamResource {
  constructor(app, entity) {
    Object.assign(this, { app, entity, container: null, degree: -1, uploaded: 0 });
    this.textures = {};
    /** Colour behind everything. */
    this.background = [0, 0, 0];
  }

  take(update) {
    const { used, degree, places } = update;
    this.uploaded = 0;
    const capacity = update.textures.geometry.capacity;
    if (!this.container || capacity !== this.container.maxSplats || degree !== this.degree) {
      // After a change of size everything is sent anew.
      if (!update.textures.geometry.all) return true;
      this._begin(capacity, degree);
    }
    const texels = { geometry: GEOMETRY_TEXELS, colours: colourTexels(degree) };
    for (const [name, packed] of Object.entries(update.textures)) this._upload(name, texels[name], packed);
    this._move(places, used);
    this.background = update.background;
    return true;
  }

  draw() {
    // PlayCanvas draws.
  }

  dispose() {
    this.entity.destroy();
    this.container?.destroy();
    for (const texture of Object.values(this.textures)) texture.destroy();
  }

  _begin(capacity, degree) {
    const { app, entity, container } = this;
    const format = new GSplatFormat(app.graphicsDevice, [], { readGLSL: reading(degree) });
    this.container = new GSplatContainer(app.graphicsDevice, capacity, format);
    this.degree = degree;
    if (entity.gsplat) entity.gsplat.resource = this.container;
    else entity.addComponent("gsplat", { resource: this.container });
    // The engine copies what it draws. Once for each frame would do, but 2.23 forgets that where an order comes meanwhile;
    // and colours depend on where the camera stands.
    entity.gsplat.workBufferUpdate = WORKBUFFER_UPDATE_ALWAYS;
    container?.destroy();
  }

  /** Copy what changed and send its texture: the engine offers pages no way to send a part of one. */
  _upload(name, texels, { capacity, all, parts }) {
    const shift = shiftOf(texels);
    if (all || !this.textures[name]) {
      this.textures[name]?.destroy();
      this.textures[name] = new Texture(this.app.graphicsDevice, {
        name: `gsstream-${name}`,
        width: 2 ** shift * texels,
        height: capacity >> shift,
        format: PIXELFORMAT_RGBA32F,
        mipmaps: false,
        minFilter: FILTER_NEAREST,
        magFilter: FILTER_NEAREST,
      });
      const uniform = `gsstream${name[0].toUpperCase()}${name.slice(1)}`;
      this.entity.gsplat.setParameter(uniform, this.textures[name]);
    }
    if (!parts.length) return;
    const values = this.textures[name].lock();
    for (const { runs, data } of parts) {
      for (let i = 0, at = 0; i < runs.length; i += 2) {
        const size = 4 * texels * (runs[i + 1] - runs[i]);
        values.set(data.subarray(at, at + size), 4 * texels * runs[i]);
        at += size;
      }
    }
    this.textures[name].unlock();
    this.uploaded += values.byteLength;
  }

  /** Tell the engine where the splats are, by which it sorts. */
  _move({ slots, positions }, used) {
    const { container } = this;
    const { centers } = container;
    if (slots) slots.forEach((slot, i) => centers.set(positions.subarray(3 * i, 3 * i + 3), 3 * slot));
    else centers.set(positions);
    const [low, high] = [new Vec3(Infinity, Infinity, Infinity), new Vec3(-Infinity, -Infinity, -Infinity)];
    for (let at = 0; at < 3 * used; at += 3) {
      // Where there is none, none is drawn, but it is sorted.
      if (Number.isNaN(centers[at])) centers.fill(0, at, at + 3);
      const place = new Vec3(centers[at], centers[at + 1], centers[at + 2]);
      low.min(place);
      high.max(place);
    }
    container.aabb = new BoundingBox();
    container.aabb.setMinMax(low, high);
    container.update(used, !slots || slots.length > 0);
  }
}

/**
 * A stream in a PlayCanvas scene. `entity` is what to add; call `update` before every picture. `player` plays, pauses and
 * seeks as on the page of a package.
 *
 * The recording's axes are kept (often z or -y is up): turn `entity` as the scene needs it; `upright` gives a turn.
 */
export class SplatStream {
  /** `app`: the Application of the scene. `options`: those of Player. */
  constructor(app, options = {}) {
    this.app = app;
    this.entity = new Entity("gsstream", app);
    this.resource = new StreamResource(app, this.entity);
    this.player = new Player(app.graphicsDevice.canvas, { ...options, renderer: this.resource });
  }

  /** Open a manifest or a .gss file; resolves when its first frame is decoded. */
  open(url) {
    return this.player.open(url);
  }

  /** Call it before every picture, with the entity of its camera. */
  update({ camera: lens }) {
    const { height } = this.app.graphicsDevice;
    const { gsplat } = this.entity;
    if (!gsplat || !this.player.view) return;
    const matrix = new Mat4().copy(lens.projectionMatrix);
    lens.calculateProjection?.(matrix);
    const focal = (matrix.data[5] * height) / 2;
    // Drawn larger, a splat still covers a pixel of the recording.
    const blur = BLUR * Math.max(1, height / this.player.view.height) ** 2 - GIVEN;
    gsplat.setParameter("gsstreamBlur", blur / focal ** 2);
  }

  /** The turn that takes the recording's up direction to y, as a Quat. */
  get upright() {
    return new Quat().setFromDirections(new Vec3(...this.player.pivot.up), Vec3.UP);
  }

  /** Put a camera, an entity, where the player's view is, as far as such a camera can show its picture. */
  place(camera) {
    const { view } = this.player;
    const axes = [view.right, view.down.map((v) => -v), view.forward.map((v) => -v)];
    const pose = new Mat4().set([...axes.flatMap((axis) => [...axis, 0]), ...view.eye, 1]);
    pose.mul2(this.entity.getWorldTransform(), pose);
    camera.setPosition(pose.getTranslation());
    camera.setRotation(new Quat().setFromMat4(pose));
    const lens = camera.camera;
    lens.nearClip = view.near;
    lens.calculateProjection = (matrix) => {
      matrix.setPerspective(60, lens.aspectRatio, lens.nearClip, lens.farClip);
      // The middle of the view need not be that of its picture, nor its pixels be square.
      const { width, height } = this.app.graphicsDevice;
      const { fx, fy, cx, cy } = cameraOf(view, width, height);
      matrix.data[0] = (2 * fx) / width;
      matrix.data[5] = (2 * fy) / height;
      matrix.data[8] = 1 - (2 * cx) / width;
      matrix.data[9] = (2 * cy) / height - 1;
    };
  }

  dispose() {
    this.player.dispose();
  }
}
