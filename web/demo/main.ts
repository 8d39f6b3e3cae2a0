// The page: a frame in, its smoothed self beside it.

import type { About, Camera, CameraLike, Frame, PictureKind, Result, Settings, Side } from "../src/index";
import { ask } from "./calls";
import { CloudView } from "./cloud";

interface Picture {
  width: number;
  height: number;
  rgba: Uint8ClampedArray<ArrayBuffer>;
}

const find = <T extends HTMLElement>(selector: string) => document.querySelector<T>(selector)!;
const form = find<HTMLFormElement>("#controls");
const control = (name: string) => form.elements.namedItem(name) as HTMLInputElement & HTMLSelectElement;

let frame: Frame | undefined;
let result: Result | undefined;
/** The text of a camera file that was opened; else the fields say the camera. */
let cameraFile: string | undefined;
let name = "simulated";
let seed = 1;
let cloudView: CloudView | undefined;
let hasGpu = false;
/** Grows with every change: results of older ones are dropped. */
let version = 0;

function say(text: string): void {
  find("#status").textContent = text;
}

function fail(error: unknown): void {
  const shown = find("#error");
  shown.textContent = error instanceof Error ? error.message : String(error);
  shown.hidden = false;
}

function why(of: string, reason: string): void {
  find(`.why[data-of="${of}"]`).textContent = reason;
  const named = of === "png" ? find<HTMLButtonElement>('[data-format="png"]') : control(of);
  named.disabled = reason !== "";
}

/** Switches off what changes nothing, and says why. */
function explain(): void {
  const isGeneral = frame?.kind === "general";
  const noGrid = isGeneral ? "A cloud without a pixel grid has no window and no sensor." : "";
  why("strength", noGrid || (control("preset").value === "" ? "" : "The preset sets it: choose “by strength”."));
  why("sensor", noGrid || (control("preset").value === "paper" && !control("edges").checked ? "The 2011 setting has a fixed radius." : ""));
  why("window", noGrid);
  why("edges", "");
  why("webgpu", isGeneral ? "Clouds without a grid are smoothed by the CPU here." : hasGpu ? "" : (withoutGpu ?? ""));
  why("png", frame && frame.kind !== "depth" ? "The frame came as points; a PNG holds depth." : "");
  const colour = control("kind").querySelector<HTMLOptionElement>('[value="colour"]')!;
  colour.disabled = !frame?.has_colour;
  find(`.why[data-of="kind"]`).textContent = frame?.has_colour ? "" : "The frame has no colour of its own.";
  find("#camera-fields").hidden = !frame?.assumed_camera;
}
let withoutGpu: string | undefined;

function settings(): Settings {
  const [preset, sensor, samples] = [control("preset").value, control("sensor").value, control("window").value];
  const isGrid = frame?.kind !== "general";
  return {
    ...(preset ? { preset: preset as NonNullable<Settings["preset"]> } : isGrid ? { strength: Number(control("strength").value) } : {}),
    ...(isGrid && sensor ? { sensor } : {}),
    ...(isGrid && samples ? { window: Number(samples) } : {}),
    edges: control("edges").checked ? "robust" : "off",
  };
}

const CAMERA_FIELDS = ["fx", "fy", "cx", "cy", "depth_scale"] as const;

function camera(): CameraLike | undefined {
  if (!frame?.assumed_camera) return undefined;
  if (cameraFile !== undefined) return cameraFile;
  return Object.fromEntries(CAMERA_FIELDS.map((field) => [field, Number(control(field).value)])) as unknown as Camera;
}

function setCamera(of: Camera): void {
  cameraFile = undefined;
  for (const field of CAMERA_FIELDS) control(field).value = String(of[field] ?? "");
}

function paint(canvas: HTMLCanvasElement, { width, height, rgba }: Picture): void {
  [canvas.width, canvas.height] = [width, height];
  canvas.getContext("2d")!.putImageData(new ImageData(rgba, width, height), 0, 0);
}

/** Draws both sides, or the cloud. */
async function draw(): Promise<void> {
  const [drawn, at] = [frame, version];
  if (!drawn || !result) return;
  const [layout, kind] = [control("layout").value, control("kind").value as PictureKind];
  const smoothed: Side = { result: result.result };
  const isCloud = layout.startsWith("cloud");
  find("#pictures").hidden = isCloud;
  find("#cloud").hidden = !isCloud;
  if (isCloud) {
    cloudView ??= new CloudView(find<HTMLCanvasElement>("#cloud"));
    const side = layout === "cloud-raw" ? "raw" : smoothed;
    const { points, rgba } = await ask<{ points: Float32Array<ArrayBuffer>; rgba: Uint8Array<ArrayBuffer> }>({
      method: "cloud", frame: drawn, side, kind, camera: camera(),
    });
    if (at === version) cloudView.show(points, rgba);
    return;
  }
  find("#pictures").className = layout;
  const pictures = await Promise.all(
    (["raw", smoothed] as Side[]).map((side) => ask<Picture>({ method: "picture", frame: drawn, side, kind, camera: camera() })),
  );
  if (at !== version) return;
  paint(find<HTMLCanvasElement>("#raw"), pictures[0]!);
  paint(find<HTMLCanvasElement>("#smoothed"), pictures[1]!);
}

/** Draws the raw side alone, which need not wait for the smoothed one. */
async function drawRaw(): Promise<void> {
  const [drawn, at] = [frame, version];
  if (!drawn || control("layout").value.startsWith("cloud")) return;
  const kind = control("kind").value as PictureKind;
  const picture = await ask<Picture>({ method: "picture", frame: drawn, side: "raw", kind, camera: camera() });
  if (at === version) paint(find<HTMLCanvasElement>("#raw"), picture);
}

/** Smooths the frame by the controls and draws it. */
async function update(): Promise<void> {
  const [smoothed, at] = [frame, ++version];
  explain();
  if (!smoothed) return;
  document.body.setAttribute("aria-busy", "true");
  try {
    const done = await ask<Result>({ method: "smooth", frame: smoothed, settings: settings(), camera: camera(), webgpu: control("webgpu").checked });
    if (at !== version) {
      await ask({ method: "release", held: [done] });
      return;
    }
    if (result) await ask({ method: "release", held: [result] });
    result = done;
    find("#error").hidden = true;
    await draw();
    const engine = done.engine === "webgpu" ? "WebGPU" : "WebAssembly";
    const size = smoothed.kind === "general" ? "" : `${smoothed.width}x${smoothed.height}, `;
    say(`${name} (${smoothed.format}): ${size}${done.points.toLocaleString("en")} points, ${done.milliseconds.toFixed(0)} ms by ${engine}`);
  } catch (error) {
    if (at === version) fail(error);
  } finally {
    if (at === version) document.body.removeAttribute("aria-busy");
  }
}

/** Takes another frame in place of the one that is there. */
async function take(opening: Promise<Frame>, called: string): Promise<void> {
  try {
    const opened = await opening;
    const held = [frame, result].filter((held) => held !== undefined);
    [frame, result, name] = [opened, undefined, called];
    if (held.length > 0) await ask({ method: "release", held });
    if (opened.assumed_camera) setCamera(opened.assumed_camera);
    if (!opened.has_colour && control("kind").value === "colour") control("kind").value = "relief";
    await drawRaw();
    await update();
  } catch (error) {
    fail(error);
  }
}

async function openFile(file: File | undefined): Promise<void> {
  if (!file) return;
  say(`Reading ${file.name}...`);
  await take(file.arrayBuffer().then((bytes) => ask<Frame>({ method: "open", name: file.name, bytes })), file.name);
}

async function save(format: string): Promise<void> {
  if (!result) return;
  try {
    const bytes = await ask<Uint8Array<ArrayBuffer>>({ method: "write", result, format, camera: camera() });
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([bytes]));
    link.download = `${name.replace(/\.[^.]*$/, "")}-smoothed.${format}`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
  } catch (error) {
    fail(error);
  }
}

function listen(): void {
  form.addEventListener("submit", (event) => event.preventDefault());
  form.addEventListener("change", ({ target }) => {
    const { name: changed } = target as HTMLInputElement;
    if (changed === "kind" || changed === "layout") void draw().catch(fail);
    else if ((CAMERA_FIELDS as readonly string[]).includes(changed)) {
      cameraFile = undefined;
      void update();
    } else if (changed) void update();
  });
  find("#file").addEventListener("change", ({ target }) => void openFile((target as HTMLInputElement).files?.[0]));
  find("#camera-file").addEventListener("change", async ({ target }) => {
    cameraFile = await (target as HTMLInputElement).files?.[0]?.text();
    void update();
  });
  find("#sample").addEventListener("click", () => {
    seed += 1;
    void take(ask<Frame>({ method: "simulate", seed }), "simulated");
  });
  find("#save").addEventListener("click", ({ target }) => {
    const { format } = (target as HTMLElement).dataset;
    if (format) void save(format);
  });
  const divider = find<HTMLInputElement>("#divider");
  divider.addEventListener("input", () => find("#pictures").style.setProperty("--split", `${divider.value}%`));
  document.addEventListener("dragover", (event) => {
    event.preventDefault();
    document.body.classList.add("dropping");
  });
  document.addEventListener("dragleave", (event) => {
    if (!event.relatedTarget) document.body.classList.remove("dropping");
  });
  document.addEventListener("drop", (event) => {
    event.preventDefault();
    document.body.classList.remove("dropping");
    void openFile(event.dataTransfer?.files[0]);
  });
}

async function start(): Promise<void> {
  listen();
  const about = await ask<About & { adapter?: string; withoutGpu?: string; isSoftware: boolean }>({ method: "about" });
  [hasGpu, withoutGpu] = [about.adapter !== undefined, about.withoutGpu];
  control("webgpu").defaultChecked = hasGpu && !about.isSoftware;
  control("sensor").replaceChildren(...about.sensors.concat("auto").map((sensor) => new Option(sensor, sensor)));
  const gpu = about.isSoftware ? `a GPU in software, ${about.adapter}: WebAssembly is faster` : about.adapter;
  const has = hasGpu ? `WebGPU: ${gpu}` : `No WebGPU (${about.withoutGpu}; Chrome and Edge have it, and newer Safari and Firefox)`;
  find("#about").textContent = `planish ${about.version}. ${has}.`;
  await take(ask<Frame>({ method: "simulate", seed }), "simulated");
}

start().catch(fail);
