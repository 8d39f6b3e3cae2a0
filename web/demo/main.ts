// The page: shows a frame and its smoothed version side by side.

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
/** The camera given for frames of this size; without it, the camera is assumed. */
let given: { camera: Camera; width: number; height: number } | undefined;
let name = "simulated";
let seed = 1;
let cloudView: CloudView | undefined;
let hasGpu = false;
let withoutGpu: string | undefined;
/** Incremented with every change; results of older versions are dropped. */
let version = 0;
/** Incremented with every requested frame; only the newest request is shown, whichever file is read first. */
let asked = 0;
let isComputing = false;
/** Last status of a frame, restored if another frame cannot be opened. */
let settledStatus = "";

function say(text: string): void {
  find("#status").textContent = text;
}

function settle(text: string): void {
  settledStatus = text;
  say(text);
}

function fail(error: unknown): void {
  const shown = find("#error");
  shown.textContent = error instanceof Error ? error.message : String(error);
  shown.hidden = false;
}

function why(of: string, reason: string): void {
  const shown = find(`.why[data-of="${of}"]`);
  const named = of === "png" ? find<HTMLButtonElement>('[data-format="png"]') : control(of);
  shown.textContent = reason;
  shown.id = `why-${of}`;
  named.setAttribute("aria-describedby", shown.id);
  named.disabled = reason !== "";
}

/** Disables controls without effect, and explains why. */
function explain(): void {
  const isGeneral = frame?.kind === "general";
  const noGrid = isGeneral ? "This setting has no effect on unorganized clouds." : "";
  why("strength", noGrid || (control("preset").value === "" ? "" : "The preset determines the strength; to set it, choose the preset “by strength”."));
  why("sensor", noGrid || (control("preset").value === "paper" && !control("edges").checked ? "The preset “paper” uses a fixed radius unless edges are kept." : ""));
  why("window", noGrid);
  why("edges", "");
  why("webgpu", isGeneral ? "The browser smooths unorganized clouds on the CPU." : hasGpu ? "" : (withoutGpu ?? ""));
  if (hasGpu && !isGeneral && result?.withoutGpu) find('.why[data-of="webgpu"]').textContent = result.withoutGpu;
  why("png", frame && frame.kind !== "depth" ? "A PNG stores depth, but this frame has points." : "");
  const colour = control("kind").querySelector<HTMLOptionElement>('[value="colour"]')!;
  colour.disabled = !frame?.hasColour;
  find(`.why[data-of="kind"]`).textContent = frame?.hasColour ? "" : "The frame has no colour.";
  find("#camera-fields").hidden = !frame?.assumedCamera;
  for (const button of find("#save").querySelectorAll("button")) {
    button.disabled = !result || (button.dataset["format"] === "png" && frame?.kind !== "depth");
  }
}

/**
 * Sets the default: edges are kept, except with the preset "paper" and in clouds without a grid, for which the command
 * decides from the data.
 */
function defaultEdges(): void {
  control("edges").checked = frame?.kind !== "general" && control("preset").value !== "paper";
}

/** Settings from a file that have no control on the page. */
let others: Settings = {};

function settings(): Settings {
  const [preset, sensor, samples] = [control("preset").value, control("sensor").value, control("window").value];
  const isGrid = frame?.kind !== "general";
  return {
    ...others,
    ...(preset ? { preset: preset as NonNullable<Settings["preset"]> } : isGrid ? { strength: Number(control("strength").value) } : {}),
    ...(isGrid && sensor ? { sensor } : {}),
    ...(isGrid && samples ? { window: Number(samples) } : {}),
    edges: control("edges").checked ? "robust" : "off",
  };
}

/** Downloads bytes or text as a file. */
function download(content: BlobPart, fileName: string): void {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([content]));
  link.download = fileName;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

async function saveSettings(): Promise<void> {
  try {
    download(await ask<string>({ method: "writeSettings", settings: settings() }), "planish-settings.json");
  } catch (error) {
    fail(error);
  }
}

/** Applies a settings file. Controls show the settings that they represent; all other settings are kept unchanged. */
async function openSettings(file: File | undefined): Promise<void> {
  if (!file) return;
  try {
    const { preset, strength, sensor, window: samples, edges, ...rest } = await ask<Settings>({ method: "readSettings", text: await file.text() });
    const isNamed = sensor === undefined || typeof sensor === "string";
    others = { ...rest, ...(isNamed ? {} : { sensor }) };
    control("preset").value = strength === undefined ? (preset ?? "default") : "";
    if (strength !== undefined) control("strength").value = String(strength);
    control("sensor").value = isNamed ? (sensor ?? "kinect1") : "";
    control("window").value = samples === undefined ? "" : String(samples);
    if (samples !== undefined && control("window").value === "") others = { ...others, window: samples };
    if (edges === undefined) defaultEdges();
    else control("edges").checked = edges === "robust";
    await update();
  } catch (error) {
    fail(new Error(`${file.name}: ${error instanceof Error ? error.message : String(error)}`));
  }
}

const CAMERA_FIELDS = ["fx", "fy", "cx", "cy", "depthUnitsPerMetre"] as const;

function camera(): CameraLike | undefined {
  if (!frame?.assumedCamera) return undefined;
  return given?.camera ?? frame.assumedCamera;
}

/** Shows the camera in the input fields. */
function showCamera(): void {
  const shown = given?.camera ?? frame?.assumedCamera;
  for (const field of CAMERA_FIELDS) control(field).value = String(shown?.[field] ?? "");
}

/** Uses the values of the input fields as the camera; a distortion from a file is kept. */
function takeFields(): void {
  if (!frame?.assumedCamera) return;
  const numbers = CAMERA_FIELDS.map((field) => [field, control(field).valueAsNumber] as const);
  const wrong = numbers.find(([, number]) => !Number.isFinite(number));
  if (wrong) return fail(new Error(`${wrong[0] === "depthUnitsPerMetre" ? "units per metre" : wrong[0]} of the camera must be a number`));
  const camera = { ...(given?.camera ?? frame.assumedCamera), ...Object.fromEntries(numbers) } as Camera;
  given = { camera, width: frame.width, height: frame.height };
  void update();
}

async function openCamera(file: File | undefined): Promise<void> {
  if (!file || !frame) return;
  const of = frame;
  try {
    if (!of.assumedCamera) throw new Error("this frame has points and needs no camera");
    const camera = await ask<Camera>({ method: "readCamera", frame: of, text: await file.text() });
    if (frame !== of) return;
    given = { camera, width: of.width, height: of.height };
    showCamera();
    find<HTMLDetailsElement>("#camera-fields").open = true;
    await update();
  } catch (error) {
    fail(new Error(`${file.name}: ${error instanceof Error ? error.message : String(error)}`));
  }
}

function paint(canvas: HTMLCanvasElement, { width, height, rgba }: Picture): void {
  [canvas.width, canvas.height] = [width, height];
  canvas.getContext("2d")!.putImageData(new ImageData(rgba, width, height), 0, 0);
}

/** Clears the smoothed picture of the previous frame. */
function clearSmoothed(): void {
  const [raw, smoothed] = [find<HTMLCanvasElement>("#raw"), find<HTMLCanvasElement>("#smoothed")];
  [smoothed.width, smoothed.height] = [raw.width, raw.height];
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
    try {
      cloudView ??= new CloudView(find<HTMLCanvasElement>("#cloud"));
    } catch (error) {
      control("layout").value = "divider";
      fail(error);
      return draw();
    }
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

/** Draws the raw side without waiting for the smoothed side. */
async function drawRaw(): Promise<void> {
  const [drawn, at] = [frame, version];
  if (!drawn || control("layout").value.startsWith("cloud")) return;
  const kind = control("kind").value as PictureKind;
  const picture = await ask<Picture>({ method: "picture", frame: drawn, side: "raw", kind, camera: camera() });
  if (at === version) paint(find<HTMLCanvasElement>("#raw"), picture);
}

/** Smooths the frame with the controls' settings, and draws it. Changes in the meantime cause one more run. */
async function update(): Promise<void> {
  version += 1;
  explain();
  if (isComputing || !frame) return;
  isComputing = true;
  document.body.setAttribute("aria-busy", "true");
  try {
    for (let done = 0; done !== version;) {
      done = version;
      await compute(done);
    }
  } finally {
    isComputing = false;
    document.body.removeAttribute("aria-busy");
  }
}

async function compute(at: number): Promise<void> {
  const smoothed = frame!;
  const slow = setTimeout(() => say(`Smoothing ${name}...`), 500);
  try {
    const done = await ask<Result>({ method: "smooth", frame: smoothed, settings: settings(), camera: camera(), webgpu: control("webgpu").checked });
    if (at !== version) return void (await ask({ method: "release", held: [done] }));
    const before = result;
    result = done;
    if (before) await ask({ method: "release", held: [before] });
    find("#error").hidden = true;
    explain();
    await draw();
    if (at !== version) return;
    const engine = done.engine === "webgpu" ? "WebGPU" : "WebAssembly";
    const size = smoothed.kind === "general" ? "" : `${smoothed.width}x${smoothed.height}, `;
    const points = done.points === 1 ? "1 point" : `${done.points.toLocaleString("en")} points`;
    settle(`${name} (${smoothed.format}): ${size}${points}, ${done.milliseconds.toFixed(0)} ms by ${engine}`);
  } catch (error) {
    if (at !== version) return;
    const before = result;
    result = undefined;
    clearSmoothed();
    explain();
    fail(error);
    settle(`${name} (${smoothed.format}): not smoothed`);
    if (before) await ask({ method: "release", held: [before] }).catch(() => undefined);
  } finally {
    clearTimeout(slow);
  }
}

/** Replaces the current frame unless a newer request was made, and returns whether it was replaced. */
async function take(opening: () => Promise<Frame>, called: string): Promise<boolean> {
  const ticket = ++asked;
  say(`Reading ${called}...`);
  try {
    const opened = await opening();
    if (ticket !== asked) {
      await ask({ method: "release", held: [opened] });
      return false;
    }
    const held = [frame, result].filter((held) => held !== undefined);
    const wasGeneral = frame?.kind === "general";
    version += 1;
    [frame, result, name] = [opened, undefined, called];
    if (given && (given.width !== opened.width || given.height !== opened.height)) given = undefined;
    showCamera();
    if (wasGeneral !== (opened.kind === "general")) defaultEdges();
    if (!opened.hasColour && control("kind").value === "colour") control("kind").value = "relief";
    if (held.length > 0) await ask({ method: "release", held });
    await drawRaw();
    if (frame === opened && !result) clearSmoothed();
    await update();
    return true;
  } catch (error) {
    if (ticket === asked) {
      fail(error);
      say(settledStatus);
    }
    return false;
  }
}

/** Opens a frame, a camera file, or one of each. If several frames are given, opens the first. */
async function openFiles(files: Iterable<File> | null | undefined): Promise<void> {
  const isCamera = (file: File) => /\.(json|ya?ml)$/i.test(file.name);
  const all = [...(files ?? [])];
  const [frames, cameras] = [all.filter((file) => !isCamera(file)), all.filter(isCamera)];
  const [first] = frames;
  if (first) {
    const taken = await take(async () => ask<Frame>({ method: "open", name: first.name, bytes: await first.arrayBuffer() }), first.name);
    if (!taken) return;
  }
  if (cameras[0]) await openCamera(cameras[0]);
  if (frames.length > 1) fail(new Error(`${frames.length} frames were dropped: ${first!.name} is shown, the others are not opened`));
}

async function save(format: string): Promise<void> {
  if (!result) return;
  try {
    const bytes = await ask<Uint8Array<ArrayBuffer>>({ method: "write", result, format, camera: camera() });
    download(bytes, `${name.replace(/\.[^.]*$/, "")}-smoothed.${format}`);
  } catch (error) {
    fail(error);
  }
}

function listen(): void {
  form.addEventListener("submit", (event) => event.preventDefault());
  form.addEventListener("change", ({ target }) => {
    const { name: changed } = target as HTMLInputElement;
    if (changed === "kind" || changed === "layout") void draw().catch(fail);
    else if ((CAMERA_FIELDS as readonly string[]).includes(changed)) takeFields();
    else if (changed) {
      if (changed === "preset") defaultEdges();
      void update();
    }
  });
  for (const selector of ["#file", "#camera-file", "#settings-file"]) {
    // Allow choosing the same file again.
    find(selector).addEventListener("click", ({ target }) => ((target as HTMLInputElement).value = ""));
  }
  find("#file").addEventListener("change", ({ target }) => void openFiles((target as HTMLInputElement).files));
  find("#camera-file").addEventListener("change", ({ target }) => void openCamera((target as HTMLInputElement).files?.[0]));
  find("#settings-file").addEventListener("change", ({ target }) => void openSettings((target as HTMLInputElement).files?.[0]));
  find("#save-settings").addEventListener("click", () => void saveSettings());
  find("#sample").addEventListener("click", () => {
    seed += 1;
    void take(() => ask<Frame>({ method: "simulate", seed }), "simulated");
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
    void openFiles(event.dataTransfer?.files);
  });
}

async function start(): Promise<void> {
  listen();
  const about = await ask<About & { adapter?: string; withoutGpu?: string; isSoftware: boolean }>({ method: "about" });
  [hasGpu, withoutGpu] = [about.adapter !== undefined, about.withoutGpu];
  control("webgpu").defaultChecked = hasGpu && !about.isSoftware;
  control("sensor").replaceChildren(...about.sensors.concat("auto").map((sensor) => new Option(sensor, sensor)));
  const gpu = about.isSoftware ? `a software GPU (${about.adapter}); WebAssembly is faster` : about.adapter;
  const has = hasGpu ? `WebGPU: ${gpu}` : `No WebGPU (${about.withoutGpu}; Chrome, Edge, and recent Safari and Firefox support it)`;
  find("#about").textContent = `planish ${about.version}. ${has}.`;
  // `planish view` passes the names of its files in the fragment of the URL.
  const named = location.hash.slice(1).split(",").filter(Boolean);
  if (named.length === 0) return void (await take(() => ask<Frame>({ method: "simulate", seed }), "simulated"));
  const get = async (file: string) => {
    const response = await fetch(`./${file}`);
    if (!response.ok) throw new Error(`${file}: ${response.statusText}`);
    return new File([await response.blob()], decodeURIComponent(file));
  };
  await openFiles(await Promise.all(named.map(get)).catch((error) => (fail(error), [])));
}

start().catch((error) => {
  fail(error);
  say("planish did not start.");
  form.querySelectorAll("fieldset").forEach((fieldset) => (fieldset.disabled = true));
});
