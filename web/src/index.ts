// planish in the browser: depth or points in, smoothed points, normals and status out.

import { Core, PlanishError } from "./core.js";
import { FrameTooLarge, Gpu, type Plan } from "./webgpu.js";

export { PlanishError } from "./core.js";

/** Settings; missing fields take the preset's values. The command, Python and ROS use the same names in snake_case. */
export interface Settings {
  preset?: "light" | "default" | "strong" | "paper";
  /** Strength from 0 (light) to 1 (strong), instead of a preset. */
  strength?: number;
  /**
   * "kinect1", "d415", "d435", "d455", "azure-kinect", "l515", "iphone" or "exact"; "auto" to estimate the sensor; or
   * coefficients of 1, z and z² in metres.
   */
  sensor?: string | { step?: [number, number, number]; sigma: [number, number, number] };
  edges?: "robust" | "off";
  /** Whether isolated points of clouds without a grid become holes. */
  removeIsolated?: boolean;
  /** Half-width of the window in samples, 1 to 7. */
  window?: number;
  /** Distance between samples in pixels, 1 to 8. */
  stride?: number;
  averageBlocks?: boolean;
  /** Radius in metres, or "sensor", which grows with distance like the sensor's noise. */
  radiusM?: number | "sensor";
  /** For unorganized clouds: number of neighbours, 6 to 1000, instead of a radius. */
  neighbours?: number;
  /** Degree of the surface, 1 to 3. */
  degree?: number;
  /** Bandwidth of the Gaussian weights in metres [default: the radius]. */
  bandwidthM?: number;
  /** Damping of slopes and curvatures, 1e-3 (weak) to 100 (a plane). */
  ridge?: number;
  project?: "ray" | "normal";
}

/** Intrinsics in pixels; `depthUnitsPerMetre` is the number of depth units per metre [default: 1000]. */
export interface Camera {
  fx: number;
  fy: number;
  cx: number;
  cy: number;
  depthUnitsPerMetre?: number;
  width?: number;
  height?: number;
  distortion?: number[];
}

/** A camera, or the text of a camera file (JSON, ROS camera_info, a 3x3 matrix, COLMAP). */
export type CameraLike = Camera | string;

/** A frame that planish keeps until it is released. */
export interface Frame {
  frame: number;
  kind: "depth" | "depth_metres" | "points" | "general";
  width: number;
  height: number;
  /** Number of pixels or points with a measurement. */
  valid: number;
  format: string;
  hasColour: boolean;
  /** For depth: an initial camera with a Kinect's field of view. */
  assumedCamera?: Camera;
}

/** A smoothed frame that planish keeps until it is released. */
export interface Result {
  result: number;
  width: number;
  height: number;
  /** Number of finite points. */
  points: number;
  /** Number of pixels of each status, in the order of {@link About.statuses}. */
  statusCounts: number[];
  /** The engine that computed the result. */
  engine: "webgpu" | "wasm";
  /** Time from the call to the result in milliseconds, including the compilation of kernels, which happens once. */
  milliseconds: number;
  /** Reason why WebGPU was not used although it was requested. */
  withoutGpu?: string;
}

/** The arrays of a result, pixel by pixel, row by row. */
export interface Smoothed {
  width: number;
  height: number;
  /** x, y and z of each pixel in metres, NaN for holes. */
  points: Float32Array;
  /** The unit normal of each pixel towards the sensor, NaN for pixels without one. */
  normals: Float32Array;
  /** Status of each pixel: an index into {@link About.statuses}. */
  status: Uint8Array;
  engine: "webgpu" | "wasm";
  milliseconds: number;
  /** Reason why WebGPU was not used although it was requested. */
  withoutGpu?: string;
}

/** The version of planish, and the names of presets, settings, sensors and statuses. */
export interface About {
  version: string;
  presets: string[];
  /** Names of all settings, as in settings files. */
  settings: string[];
  sensors: string[];
  statuses: string[];
  simd: string;
}

export type PictureKind = "relief" | "depth" | "normals" | "colour";
/** The raw frame, or a result of the frame. */
export type Side = "raw" | { result: number };

export interface LoadOptions {
  /** The module's bytes or URL [default: `planish.wasm` next to this file]. */
  wasm?: BufferSource | URL | string;
  /** Whether to open WebGPU [default: true]. */
  webgpu?: boolean;
}

/** planish: a WebAssembly module, and WebGPU if available. */
export class Planish {
  private gpu: Gpu | undefined;
  /** Whether frames are smoothed by WebGPU if it is available; initially true unless the adapter is a software GPU. */
  usesGpu = true;
  /** Reason why WebGPU is not used, or `undefined` if it is open. */
  withoutGpu: string | undefined;

  private constructor(private readonly core: Core) {}

  static async load(options: LoadOptions = {}): Promise<Planish> {
    // Bundlers look for exactly this expression and copy the module.
    const given = options.wasm ?? new URL("./planish.wasm", import.meta.url);
    const isAddress = typeof given === "string" || given instanceof URL;
    const planish = new Planish(await Core.load(isAddress ? await fetched(given) : given));
    if (options.webgpu === false) planish.withoutGpu = "WebGPU is disabled by the option webgpu";
    else await planish.openGpu();
    planish.usesGpu = !planish.isSoftware;
    return planish;
  }

  /** Returns the version, and the names of presets, settings, sensors and statuses. */
  about(): About {
    return this.core.call<About>({ op: "about" }).ok;
  }

  /** The adapter's name, or `undefined` without WebGPU. */
  get adapter(): string | undefined {
    return this.gpu?.name;
  }

  /** Whether the adapter is a software GPU. */
  get isSoftware(): boolean {
    return this.gpu?.isSoftware ?? false;
  }

  /** Size of the module's memory in bytes. */
  get memoryBytes(): number {
    return this.core.memoryBytes;
  }

  /** Smooths raw depth: `width` x `height` values, 0 for holes, in the unit that the camera states. */
  async smooth(depth: Uint16Array, camera: Camera & { width: number; height: number }, settings: Settings = {}): Promise<Smoothed> {
    if (typeof camera !== "object" || camera === null) throw new PlanishError("expected a camera as the second argument: { width, height, fx, fy, cx, cy }");
    const frame = this.depth(depth, camera.width, camera.height);
    let result: Result | undefined;
    try {
      result = await this.smoothFrame(frame, settings, camera);
      const { engine, milliseconds, withoutGpu } = result;
      return { ...this.arrays(result), engine, milliseconds, ...(withoutGpu === undefined ? {} : { withoutGpu }) };
    } finally {
      this.release(frame, ...(result ? [result] : []));
    }
  }

  /** Reads a file: PCD, PLY, NPY, 16-bit PNG, XYZ or CSV, OBJ, STL. */
  open(name: string, bytes: Uint8Array | ArrayBuffer): Frame {
    const given = bytes instanceof ArrayBuffer ? new Uint8Array(bytes) : bytes;
    if (!(given instanceof Uint8Array)) throw new PlanishError(`${name}: expected the file's bytes as Uint8Array or ArrayBuffer`);
    return this.core.call<Frame>({ op: "open", name }, given).ok;
  }

  /** Creates a frame from raw depth. */
  depth(depth: Uint16Array, width: number, height: number): Frame {
    if (!(depth instanceof Uint16Array)) throw new PlanishError("expected raw depth as Uint16Array");
    checkShape(depth.length, width, height, 1);
    return this.core.call<Frame>({ op: "depth", width, height }, bytesOf(depth)).ok;
  }

  /** Creates a frame from points on a grid: x, y and z of each pixel in metres, NaN for holes. */
  points(points: Float32Array, width: number, height: number): Frame {
    if (!(points instanceof Float32Array)) throw new PlanishError("expected points as Float32Array");
    checkShape(points.length, width, height, 3);
    return this.core.call<Frame>({ op: "points", width, height }, bytesOf(points)).ok;
  }

  /** Reads a camera file for a frame. */
  readCamera(frame: Frame, text: string): Camera {
    return this.core.call<Camera>({ op: "read_camera", frame: idOf(frame, "frame"), camera: text }).ok;
  }

  /** Reads a settings file in JSON or YAML, the format of the command and Python. */
  readSettings(text: string): Settings {
    return this.core.call<Settings>({ op: "read_settings", text }).ok;
  }

  /** Writes settings as JSON that the command (`--settings`), Python and ROS read. */
  writeSettings(settings: Settings): string {
    return this.core.call<{ text: string }>({ op: "write_settings", settings }).ok.text;
  }

  /** Simulates a frame of a Kinect v1. */
  simulate(seed = 1, width = 640, height = 480): Frame {
    return this.core.call<Frame>({ op: "simulate", seed, width, height }).ok;
  }

  /** Smooths a frame with WebGPU, or with WebAssembly if WebGPU is missing, was lost, or has no room for the frame. */
  async smoothFrame(frame: Frame, settings: Settings = {}, camera?: CameraLike): Promise<Result> {
    const start = performance.now();
    let withoutGpu: string | undefined;
    const request = { frame: idOf(frame, "frame"), settings, ...(camera === undefined ? {} : { camera }) };
    const done = (ok: Omit<Result, "engine" | "milliseconds">, engine: Result["engine"]): Result => ({
      ...ok,
      engine,
      milliseconds: performance.now() - start,
      ...(withoutGpu === undefined ? {} : { withoutGpu }),
    });
    if (this.gpu && this.usesGpu && frame.kind !== "general") {
      const gpu = this.gpu;
      let plan: Plan | undefined;
      try {
        const planned = this.core.call<Plan>({ op: "plan", ...request, limits: gpu.limits });
        plan = planned.ok;
        const output = await gpu.run(plan, planned.bytes);
        return done(this.core.call<Result>({ op: "finish", plan: plan.plan }, output).ok, "webgpu");
      } catch (error) {
        // If no plan was made, WebAssembly tries the frame below. It rejects invalid settings and frames with the same
        // message, but accepts frames beyond the device's limits.
        if (plan !== undefined) this.releaseIds([plan.plan]);
        if (plan === undefined) withoutGpu = error instanceof Error ? error.message : String(error);
        else if (error instanceof FrameTooLarge) withoutGpu = `this frame is too large for WebGPU: ${error.message}`;
        else if (error instanceof PlanishError && !(await gpu.isLost())) throw error;
        else withoutGpu = await this.loseGpu(gpu, error);
      }
    }
    return done(this.core.call<Result>({ op: "smooth", ...request }).ok, "wasm");
  }

  /** Returns the arrays of a result. */
  arrays(result: Result): Omit<Smoothed, "engine" | "milliseconds" | "withoutGpu"> {
    const { ok, bytes } = this.core.call<{ width: number; height: number }>({ op: "arrays", result: idOf(result, "result") });
    const pixels = ok.width * ok.height;
    return {
      ...ok,
      points: new Float32Array(bytes.buffer, 0, 3 * pixels),
      normals: new Float32Array(bytes.buffer, 12 * pixels, 3 * pixels),
      status: new Uint8Array(bytes.buffer, 24 * pixels, pixels),
    };
  }

  /** Renders a frame, raw or smoothed, as RGBA. */
  picture(frame: Frame, side: Side, kind: PictureKind, camera?: CameraLike): { width: number; height: number; rgba: Uint8ClampedArray<ArrayBuffer> } {
    const request = { op: "picture", frame: idOf(frame, "frame"), side: sideOf(side), kind, ...(camera === undefined ? {} : { camera }) };
    const { ok, bytes } = this.core.call<{ width: number; height: number }>(request);
    return { width: ok.width, height: ok.height, rgba: new Uint8ClampedArray(bytes.buffer) };
  }

  /** Returns the finite points of a frame, raw or smoothed, and the colour of each. */
  cloud(frame: Frame, side: Side, kind: PictureKind, camera?: CameraLike): { points: Float32Array<ArrayBuffer>; rgba: Uint8Array<ArrayBuffer> } {
    const request = { op: "cloud", frame: idOf(frame, "frame"), side: sideOf(side), kind, ...(camera === undefined ? {} : { camera }) };
    const { ok, bytes } = this.core.call<{ points: number }>(request);
    return { points: new Float32Array(bytes.buffer, 0, 3 * ok.points), rgba: new Uint8Array(bytes.buffer, 12 * ok.points) };
  }

  /** Encodes a result as a file in the format "pcd", "ply", "npy" or "xyz", or "png" for depth. */
  write(result: Result, format: string, camera?: CameraLike): Uint8Array<ArrayBuffer> {
    const request = { op: "write", result: idOf(result, "result"), format, ...(camera === undefined ? {} : { camera }) };
    return this.core.call({ ...request }).bytes;
  }

  /** Releases frames and results. */
  release(...held: (Frame | Result)[]): void {
    this.releaseIds(held.map((held) => idOf(held, "result" in Object(held) ? "result" : "frame")));
  }

  /** Releases the GPU; later frames are smoothed with WebAssembly. */
  close(): void {
    this.gpu?.close();
    this.gpu = undefined;
    this.withoutGpu = "the GPU was closed";
  }

  private releaseIds(ids: number[]): void {
    this.core.call({ op: "release", ids });
  }

  private async openGpu(): Promise<void> {
    try {
      this.gpu = await Gpu.open();
      this.withoutGpu = this.gpu ? undefined : "this browser does not support WebGPU, or has no adapter for it";
    } catch (error) {
      this.withoutGpu = `WebGPU could not be opened: ${String(error)}`;
    }
  }

  /**
   * Closes a failed device and returns the reason of the failure. If the device was lost, opens a new one. The caller
   * smooths the frame with WebAssembly.
   */
  private async loseGpu(gpu: Gpu, error: unknown): Promise<string> {
    const isLost = await gpu.isLost();
    const reason = `WebGPU failed: ${gpu.lost ?? String(error)}`;
    // Several frames in flight may report the same loss.
    if (this.gpu !== gpu) return reason;
    this.gpu = undefined;
    gpu.close();
    if (isLost) await this.openGpu();
    if (!this.gpu) this.withoutGpu = reason;
    return reason;
  }
}

/** Returns the number of a frame or result. */
function idOf(held: object | null | undefined, kind: "frame" | "result"): number {
  const id = (held as Record<string, unknown> | null | undefined)?.[kind];
  if (typeof id !== "number") throw new PlanishError(`expected a ${kind} of planish, not ${held === null ? "null" : typeof held}`);
  return id;
}

/** Reduces a result to its number, as the module expects. */
function sideOf(side: Side): Side {
  return side === "raw" ? side : { result: idOf(side, "result") };
}

function checkShape(length: number, width: number, height: number, values: number): void {
  const isSize = [width, height].every((side) => Number.isInteger(side) && side > 0);
  if (!isSize) throw new PlanishError(`width and height are ${width} and ${height}; expected whole numbers above 0`);
  if (length !== values * width * height) {
    const each = values === 1 ? "one value" : `${values} values`;
    throw new PlanishError(`found ${length} values; expected ${values * width * height}: ${width}x${height} pixels with ${each} each`);
  }
}

function bytesOf(values: Uint16Array | Float32Array): Uint8Array {
  return new Uint8Array(values.buffer, values.byteOffset, values.byteLength);
}

async function fetched(address: URL | string): Promise<Response | BufferSource> {
  if (String(address).startsWith("file:")) {
    // Node's fetch does not read files. Bundlers must not resolve this import.
    const node = "node:fs/promises";
    const files = (await import(/* @vite-ignore */ /* webpackIgnore: true */ node)) as { readFile(file: URL): Promise<Uint8Array<ArrayBuffer>> };
    return files.readFile(new URL(address));
  }
  const response = await fetch(address);
  if (!response.ok) throw new PlanishError(`${String(address)} cannot be loaded (HTTP ${response.status})`);
  // Some servers do not know the type of .wasm files, so pass the bytes instead.
  return response.headers.get("Content-Type")?.startsWith("application/wasm") ? response : response.arrayBuffer();
}
