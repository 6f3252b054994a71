// How the attributes of Gaussians lie in float32 textures: what packs them and what uploads them must agree.

const LINE = 2048;

/** Texels of one Gaussian in the texture of centres, rotations and scales. */
export const GEOMETRY_TEXELS = 3;

/** Texels of one Gaussian in the texture of colour coefficients of a degree: coefficients are packed without gaps. */
export function colourTexels(degree) {
  return Math.ceil((3 * (degree + 1) ** 2) / 4);
}

/** log2 of the Gaussians in one line of a texture with so many texels for each. */
export function shiftOf(texels) {
  return Math.floor(Math.log2(LINE / texels));
}
