/** Clouds in 3-D: one pane, or two with the same camera. Draws only where something changed. */

import {
  BufferAttribute, BufferGeometry, Color, DataTexture, Group, LinearFilter, PerspectiveCamera, Points, Quaternion, Scene,
  ShaderMaterial, Spherical, SRGBColorSpace, Vector2, Vector3, WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

import { colormap, gradient } from "./colormap.ts";
import { type Ball, ball, between, IDENTITY, moved, place, type Placement, type Rows, SAMPLE, type Triple, union } from "./geometry.ts";

/** A cloud to be shown. The first one is moved by poses; the second is what it is moved onto. */
export interface Cloud {
  /** x, y, z from `origin`, in random order, so that the first so many are a sample of all. */
  positions: Float32Array;
  /** In double precision: georeferenced coordinates are large. */
  origin: Triple;
  /** Red, green, blue of each point, where the file has them. */
  colors: Uint8Array | null;
}

/** How far each point of the first cloud is from the second, as a share of `reach` times 65535. */
export interface Distances {
  values: Uint16Array;
  reach: number;
}

export type Coloring = "clouds" | "distances" | "own";
export type Side = "before" | "after";
/** What is up: scans have z there, models often y, and what a camera sees −y. */
export const UPS = ["x", "-x", "y", "-y", "z", "-z"] as const;
export type Up = (typeof UPS)[number];

/** Colours of a theme, as CSS has them. */
export interface Palette {
  background: string;
  clouds: readonly string[];
  /** Clouds without distances beside one that has them. */
  quiet: string;
  /** The part of the colour map that stands out from the background. */
  map: readonly [number, number];
}

const VERTEX = `
attribute vec3 own;
attribute float distance_;
uniform float size, depth;
uniform vec3 flat_;
uniform int coloring;
uniform float range;
uniform sampler2D map;
uniform vec3 background;
varying vec3 shade;
void main() {
  vec4 seen = modelViewMatrix * vec4(position, 1.0);
  gl_Position = projectionMatrix * seen;
  gl_PointSize = size;
  vec3 color = coloring == 1 ? texture2D(map, vec2(min(distance_ / range, 1.0), 0.5)).rgb : coloring == 2 ? own : flat_;
  // Farther points fade a little: without light or edges nothing else tells near from far.
  shade = mix(color, background, 0.55 * smoothstep(depth - 0.9, depth + 1.1, -seen.z));
}`;
const FRAGMENT = `
varying vec3 shade;
uniform float size;
void main() {
  vec2 off = gl_PointCoord - 0.5;
  if (size > 2.5 && dot(off, off) > 0.25) discard;
  gl_FragColor = vec4(shade, 1.0);
}`;

/** Milliseconds of a frame above which fewer points are drawn while the view moves, and below which more are. */
const SLOW = 50;
const FAST = 25;
/** Points that are always drawn, of all clouds together. */
const FEWEST = 40_000;
/** So many points fill the picture. */
const MANY = 60_000;
/** Without a move for so many milliseconds, all points are drawn. */
const STILL = 160;
const FLIGHT = 700;
/** Clouds whose middles are more than so many of their radii apart are drawn side by side where they are not registered. */
const APART = 6;
const FIELD = 40;
const HOME = new Spherical(3, 1.15, 0.7);

/** A CSS colour as its own numbers, which the shader writes as they are. */
function color(text: string): Color {
  return new Color().setStyle(text, SRGBColorSpace).convertLinearToSRGB();
}

function set(points: Points<BufferGeometry, ShaderMaterial>, values: Record<string, unknown>): void {
  for (const [name, value] of Object.entries(values)) (points.material.uniforms[name] ??= { value }).value = value;
}

export class Viewer {
  /** Told when something is to be said about the drawing itself: null where all is well. */
  onTrouble: (message: string | null) => void = () => {};
  readonly canvas: HTMLCanvasElement;
  /** How far the first cloud is drawn from where it lies before registration; null where it is drawn there. */
  readonly broughtFrom: number | null;

  readonly #renderer: WebGLRenderer;
  readonly #scene = new Scene();
  readonly #world = new Group();
  readonly #camera = new PerspectiveCamera(FIELD, 1, 0.01, 100);
  #controls: OrbitControls;
  readonly #clouds: readonly Cloud[];
  readonly #drawn: Points<BufferGeometry, ShaderMaterial>[] = [];
  readonly #balls: Ball[];
  readonly #from: Triple;
  #before: Placement;
  #after: Placement;
  #flight: { from: Placement; fromHome: Ball; start: number } | null = null;
  #shown: { placement: Placement; home: Ball };
  /** Where the others lie; of the first it is of no use. */
  readonly #lying: Placement[];
  /** What the camera has to see where only some clouds are shown. */
  #framed: Ball | null = null;
  #side: Side = "before";
  #split = false;
  #up: Up = "z";
  #size = 2;
  /** Points are larger where few are shown. */
  #grown = 1;
  #share = 1;
  #moving = false;
  #stillAt = 0;
  #timer = 0;
  #drawing = false;
  #waiting = false;
  #asked = false;
  #gone = false;
  readonly #resized = new ResizeObserver(() => this.draw());
  #reach = 0;
  #distances: Record<Side, BufferAttribute | null> = { before: null, after: null };
  #palette: Palette = { background: "#fff", clouds: ["#000"], quiet: "#888", map: [0, 1] };
  #coloring: Coloring = "clouds";
  #range = 1;

  /** @param near whether a first cloud that lies far from the second is brought to it.
   *  @throws where the browser has no WebGL. */
  constructor(host: HTMLElement, clouds: readonly Cloud[], private readonly still: () => boolean, near: boolean) {
    this.#renderer = new WebGLRenderer({ antialias: true, powerPreference: "high-performance" });
    this.canvas = this.#renderer.domElement;
    this.#clouds = clouds;
    const target = clouds[1] ?? clouds[0];
    if (!target) throw new Error("there is no cloud");
    this.#from = target.origin;
    this.#balls = clouds.map((c) => ball(c.positions));
    const [source] = clouds;
    const lies = place(IDENTITY, source?.origin ?? this.#from, this.#from);
    this.#lying = clouds.map((cloud) => place(IDENTITY, cloud.origin, this.#from));
    this.broughtFrom = near ? this.#bring(lies) : null;
    this.#before = lies;
    this.#after = lies;
    this.#shown = { placement: lies, home: this.#home(lies) };

    clouds.forEach((cloud, i) => {
      const geometry = new BufferGeometry();
      geometry.setAttribute("position", new BufferAttribute(cloud.positions, 3));
      if (cloud.colors) geometry.setAttribute("own", new BufferAttribute(cloud.colors, 3, true));
      const material = new ShaderMaterial({
        vertexShader: VERTEX,
        fragmentShader: FRAGMENT,
        // All are there from the start: what is drawn with is compiled once.
        uniforms: {
          size: { value: 1 }, depth: { value: 1 }, flat_: { value: null }, coloring: { value: 0 }, range: { value: 1 },
          map: { value: null }, background: { value: null },
        },
      });
      const points = new Points(geometry, material);
      points.frustumCulled = false;
      if (i > 0) points.position.copy(this.#lying[i]?.translation ?? points.position);
      this.#drawn.push(points);
      this.#world.add(points);
    });
    this.#scene.add(this.#world);

    this.canvas.addEventListener("webglcontextlost", (event) => {
      if (this.#gone) return;
      event.preventDefault();
      this.onTrouble("The graphics driver gave up the picture. It comes back by itself where it can; else load the page again.");
    });
    this.canvas.addEventListener("webglcontextrestored", () => {
      // Of all that was set, three.js forgets this.
      this.#renderer.setClearColor(new Color(this.#palette.background));
      this.onTrouble(null);
      this.draw();
    });
    host.prepend(this.canvas);
    this.#controls = this.#newControls();
    this.reset();
    this.#resized.observe(host);
  }

  /** Frees what the graphics card holds, and takes the picture away. */
  dispose(): void {
    this.#gone = true;
    this.#resized.disconnect();
    this.#controls.dispose();
    for (const { geometry, material } of this.#drawn) {
      geometry.dispose();
      material.uniforms["map"]?.value?.dispose();
      material.dispose();
    }
    this.canvas.remove();
    this.#renderer.dispose();
    this.#renderer.forceContextLoss();
  }

  /** The pose that "after" shows; flown to from what is shown now. */
  setPose(pose: Rows): void {
    const [source] = this.#clouds;
    if (!source) return;
    this.#depart();
    this.#after = place(pose, source.origin, this.#from);
    this.draw();
  }

  setSide(side: Side): void {
    if (side === this.#side) return;
    this.#depart();
    this.#side = side;
    this.draw();
  }

  /** Before and after beside each other, or one of them. */
  setSplit(split: boolean): void {
    this.#split = split;
    this.#flight = null;
    this.#controls.zoomToCursor = !split;
    this.draw();
  }

  setVisible(cloud: number, visible: boolean): void {
    const points = this.#drawn[cloud];
    if (points) points.visible = visible;
    this.draw();
  }

  /** Only these clouds, each moved by its pose; the camera turns to them. */
  showOnly(poses: ReadonlyMap<number, Rows>): void {
    const [first] = this.#clouds;
    const pose = poses.get(0);
    if (first && pose) {
      // It is there at once, and only the camera flies.
      this.#before = this.#after = this.#shown.placement = place(pose, first.origin, this.#from);
    }
    this.#depart();
    this.#drawn.forEach((points, i) => {
      const [cloud, to] = [this.#clouds[i], poses.get(i)];
      points.visible = to !== undefined;
      if (i === 0 || !cloud || !to) return;
      const at = place(to, cloud.origin, this.#from);
      this.#lying[i] = at;
      points.quaternion.copy(at.rotation);
      points.position.copy(at.translation);
    });
    this.#framed = this.#ballOf([...poses.keys()]);
    const shown = this.#drawn.reduce((sum, points) => sum + (points.visible ? points.geometry.getAttribute("position").count : 0), 0);
    this.#grown = Math.min(Math.max(Math.sqrt(MANY / Math.max(shown, 1)), 1), 3);
    this.draw();
  }

  setSize(size: number): void {
    this.#size = size;
    this.draw();
  }

  setPalette(palette: Palette): string {
    this.#palette = palette;
    this.#renderer.setClearColor(new Color(palette.background));
    const table = colormap(...palette.map);
    const map = new DataTexture(table, table.length / 4, 1);
    map.minFilter = map.magFilter = LinearFilter;
    map.needsUpdate = true;
    for (const points of this.#drawn) {
      points.material.uniforms["map"]?.value?.dispose();
      set(points, { map, background: color(palette.background) });
    }
    this.#paint();
    return gradient(table);
  }

  /** Distances of the first cloud's points, where it lies and where it is moved to. */
  setDistances(before: Distances | null, after: Distances | null): void {
    const attribute = (d: Distances | null) => d && new BufferAttribute(d.values, 1, true);
    this.#distances = { before: attribute(before), after: attribute(after) };
    this.#reach = (before ?? after)?.reach ?? 0;
    this.#paint();
  }

  /** @param range the distance from which on colours are the last one. */
  setColoring(coloring: Coloring, range: number): void {
    this.#coloring = coloring;
    this.#range = range;
    this.#paint();
  }

  setUp(up: Up): void {
    this.#up = up;
    this.#controls.dispose();
    this.#controls = this.#newControls();
    this.reset();
  }

  /** The whole of it, from where it was seen first. */
  reset(): void {
    this.#controls.target.set(0, 0, 0);
    this.#camera.position.copy(new Vector3().setFromSpherical(HOME).applyQuaternion(this.#upright()));
    this.#controls.update();
    this.draw();
  }

  /** Turns the view, in rad. */
  orbit(sideways: number, upwards: number): void {
    const offset = this.#camera.position.clone().sub(this.#controls.target);
    const upright = this.#upright();
    const at = new Spherical().setFromVector3(offset.applyQuaternion(upright.clone().invert()));
    at.theta += sideways;
    at.phi += upwards;
    this.#lookFrom(new Vector3().setFromSpherical(at.makeSafe()).applyQuaternion(upright));
  }

  zoom(factor: number): void {
    const offset = this.#camera.position.clone().sub(this.#controls.target);
    const { minDistance, maxDistance } = this.#controls;
    this.#lookFrom(offset.setLength(Math.min(Math.max(offset.length() / factor, minDistance), maxDistance)));
  }

  /** Draws with the next frame. */
  draw(): void {
    if (this.#asked || this.#gone) return;
    this.#asked = true;
    requestAnimationFrame((now) => {
      this.#asked = false;
      if (!this.#gone) this.#frame(now);
    });
  }

  #lookFrom(offset: Vector3): void {
    this.#camera.position.copy(this.#controls.target).add(offset);
    this.#controls.update();
    this.#move();
  }

  /** From the y axis, which three.js has upwards. */
  #upright(): Quaternion {
    return new Quaternion().setFromUnitVectors(new Vector3(0, 1, 0), this.#camera.up);
  }

  #newControls(): OrbitControls {
    const along = (axis: string) => (this.#up === axis ? 1 : this.#up === `-${axis}` ? -1 : 0);
    this.#camera.up.set(along("x"), along("y"), along("z"));
    const controls = new OrbitControls(this.#camera, this.canvas);
    controls.enableDamping = false;
    controls.zoomToCursor = !this.#split;
    controls.minDistance = 0.002;
    controls.maxDistance = 30;
    controls.addEventListener("change", () => this.#move());
    return controls;
  }

  /** The view moves: fewer points are drawn, if that many take too long. */
  #move(): void {
    this.#moving = true;
    this.#stillAt = performance.now() + STILL;
    if (this.#timer === 0) this.#timer = window.setTimeout(() => this.#rest(), STILL);
    this.draw();
  }

  #rest(): void {
    const left = this.#stillAt - performance.now();
    this.#timer = left > 0 ? window.setTimeout(() => this.#rest(), left) : 0;
    if (left <= 0) {
      this.#moving = false;
      this.draw();
    }
  }

  #paint(): void {
    const { clouds, quiet } = this.#palette;
    const range = this.#reach > 0 ? this.#range / this.#reach : 1;
    this.#drawn.forEach((points, i) => {
      const far = this.#coloring === "distances";
      const coloring = far && i === 0 ? 1 : this.#coloring === "own" && this.#clouds[i]?.colors ? 2 : 0;
      set(points, { coloring, range, flat_: color((far ? quiet : clouds[i % clouds.length]) ?? quiet) });
    });
    this.draw();
  }

  #depart(): void {
    this.#flight = this.still() || this.#split
      ? null
      : { from: this.#shown.placement, fromHome: this.#shown.home, start: performance.now() };
  }

  #placement(side: Side): Placement {
    return side === "before" ? this.#before : this.#after;
  }

  /** What the camera has to see where the first cloud is at `placement`. */
  #home(placement: Placement): Ball {
    if (this.#framed) return this.#framed;
    const balls = this.#balls.map((b, i) => moved(b, i === 0 ? placement : this.#lying[i] ?? placement));
    return union(balls);
  }

  /** The ball of the points of some clouds, as they lie: many clouds have more stray points than one. */
  #ballOf(clouds: readonly number[]): Ball {
    const most = Math.ceil(SAMPLE / Math.max(clouds.length, 1));
    const at = (i: number) => (i === 0 ? this.#before : this.#lying[i]);
    // They may be far from the origin, and single precision holds what is near.
    const from = at(clouds[0] ?? 0)?.translation ?? new Vector3();
    const sample: number[] = [];
    const point = new Vector3();
    for (const i of clouds) {
      const [positions, to] = [this.#clouds[i]?.positions, at(i)];
      if (!positions || !to) continue;
      for (let k = 0; k < Math.min(positions.length, 3 * most); k += 3) {
        sample.push(...point.fromArray(positions, k).applyQuaternion(to.rotation).add(to.translation).sub(from));
      }
    }
    const { center, radius } = ball(new Float32Array(sample));
    center.add(from);
    return { center, radius: radius > 0 ? radius : 1 };
  }

  /** Brings a cloud that lies far from the second beside it; tells from how far. */
  #bring(lies: Placement): number | null {
    const [a, b] = this.#balls;
    if (!a || !b) return null;
    const at = moved(a, lies).center;
    const apart = at.distanceTo(b.center);
    const radii = a.radius + b.radius;
    if (apart <= APART * radii) return null;
    const way = at.sub(b.center).setLength(1.2 * radii - apart);
    lies.translation.add(way);
    return apart;
  }

  /** Waits until the frame is drawn, and learns from how long that took how much of the clouds can be drawn in time. */
  #watch(share: number): void {
    const gl = this.#renderer.getContext() as WebGL2RenderingContext;
    const sync = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    if (!sync) return;
    gl.flush();
    this.#drawing = true;
    const start = performance.now();
    const look = () => {
      if (!gl.isContextLost() && gl.getSyncParameter(sync, gl.SYNC_STATUS) !== gl.SIGNALED) {
        requestAnimationFrame(look);
        return;
      }
      if (this.#gone) return;
      gl.deleteSync(sync);
      this.#drawing = false;
      const took = performance.now() - start;
      if (took > SLOW) this.#share = Math.max((share * SLOW) / took, 0.001);
      else if (took < FAST && share === this.#share) this.#share = Math.min(1.15 * share, 1);
      if (this.#waiting) this.draw();
    };
    requestAnimationFrame(look);
  }

  #frame(now: number): void {
    // Frames do not queue up behind a slow one: the next shows what is wanted then.
    this.#waiting = this.#drawing;
    if (this.#waiting) return;
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement ?? this.canvas;
    if (width === 0 || height === 0) return;
    const ratio = Math.min(window.devicePixelRatio, 2);
    const size = this.#renderer.getSize(new Vector2());
    if (size.x !== width || size.y !== height || this.#renderer.getPixelRatio() !== ratio) {
      this.#renderer.setPixelRatio(ratio);
      this.#renderer.setSize(width, height);
    }

    let progress = 1;
    if (this.#flight) {
      const t = Math.min(Math.max((now - this.#flight.start) / FLIGHT, 0), 1);
      progress = t * t * (3 - 2 * t);
    }
    const busy = this.#moving || this.#flight !== null;
    const share = busy ? this.#share : 1;
    for (const { geometry } of this.#drawn) {
      const count = geometry.getAttribute("position").count;
      geometry.setDrawRange(0, Math.min(count, Math.ceil(Math.max(FEWEST / Math.max(this.#drawn.length, 2), share * count))));
    }

    const goal = this.#placement(this.#side);
    const home = this.#home(goal);
    if (this.#flight) {
      const { from, fromHome } = this.#flight;
      this.#shown = {
        placement: between(from, goal, this.#balls[0]?.center ?? new Vector3(), progress),
        home: {
          center: fromHome.center.clone().lerp(home.center, progress),
          radius: fromHome.radius + (home.radius - fromHome.radius) * progress,
        },
      };
    } else {
      this.#shown = { placement: goal, home };
    }

    this.#renderer.setScissorTest(this.#split);
    if (this.#split) {
      // Beside each other where there is room, else above each other.
      const across = width >= height;
      const [w, h] = across ? [width / 2, height] : [width, height / 2];
      this.#pane("before", this.#before, this.#home(this.#before), 0, height - h, w, h, ratio);
      this.#pane("after", this.#after, this.#home(this.#after), width - w, 0, w, h, ratio);
    } else {
      this.#pane(this.#side, this.#shown.placement, this.#shown.home, 0, 0, width, height, ratio);
    }
    this.#watch(share);
    if (progress < 1) this.draw();
    else if (this.#flight) {
      this.#flight = null;
      this.draw();
    }
  }

  #pane(
    side: Side, placement: Placement, home: Ball, x: number, y: number, width: number, height: number, ratio: number,
  ): void {
    const [source] = this.#drawn;
    source?.quaternion.copy(placement.rotation);
    source?.position.copy(placement.translation);
    const distances = this.#distances[side];
    if (distances) source?.geometry.setAttribute("distance_", distances);
    // The camera looks at a world in which what is shown has a radius of one.
    this.#world.scale.setScalar(1 / home.radius);
    this.#world.position.copy(home.center).multiplyScalar(-1 / home.radius);
    const distance = this.#camera.position.distanceTo(this.#controls.target);
    // A pane that is higher than wide sees as much to the sides as one that is square.
    this.#camera.fov = (360 / Math.PI) * Math.atan(Math.tan((FIELD * Math.PI) / 360) * Math.max(1, height / width));
    this.#camera.aspect = width / height;
    this.#camera.near = distance / 200;
    this.#camera.far = distance + 60;
    this.#camera.updateProjectionMatrix();
    for (const points of this.#drawn) set(points, { size: this.#size * this.#grown * ratio, depth: distance });
    this.#renderer.setViewport(x, y, width, height);
    this.#renderer.setScissor(x, y, width, height);
    this.#renderer.render(this.#scene, this.#camera);
  }
}
