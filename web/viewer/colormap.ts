/** Viridis (van der Walt and Smith, CC0): perceptually uniform, and legible to the colour-blind. */

const STOPS: readonly number[] = [
  0x440154, 0x48186a, 0x472d7b, 0x424086, 0x3b528b, 0x33638d, 0x2c728e, 0x26828e, 0x21918c, 0x1fa088, 0x28ae80, 0x3fbc73,
  0x5ec962, 0x84d44b, 0xaddc30, 0xd8e219, 0xfde725,
];

const SIZE = 256;

/** Red, green, blue, alpha of `SIZE` steps, of the part from `low` to `high`: what stands out from the background. */
export function colormap(low: number, high: number): Uint8Array {
  const table = new Uint8Array(4 * SIZE);
  for (let i = 0; i < SIZE; i += 1) {
    const at = (low + ((high - low) * i) / (SIZE - 1)) * (STOPS.length - 1);
    const k = Math.min(Math.floor(at), STOPS.length - 2);
    for (let c = 0; c < 3; c += 1) {
      const [a, b] = [k, k + 1].map((stop) => ((STOPS[stop] ?? 0) >> (16 - 8 * c)) & 0xff);
      table[4 * i + c] = Math.round((a ?? 0) + ((b ?? 0) - (a ?? 0)) * (at - k));
    }
    table[4 * i + 3] = 255;
  }
  return table;
}

/** The same as a CSS gradient, left to right. */
export function gradient(table: Uint8Array): string {
  const colors = Array.from({ length: 17 }, (_, i) => {
    const [r, g, b] = table.subarray(4 * Math.round((i * (SIZE - 1)) / 16));
    return `rgb(${r} ${g} ${b})`;
  });
  return `linear-gradient(to right, ${colors.join(", ")})`;
}
