// Requests from the page to its worker.

import type { CameraLike, Frame, PictureKind, Result, Settings, Side } from "../src/index";

export type Call =
  | { method: "about" }
  | { method: "open"; name: string; bytes: ArrayBuffer }
  | { method: "simulate"; seed: number }
  | { method: "readCamera"; frame: Frame; text: string }
  | { method: "smooth"; frame: Frame; settings: Settings; camera: CameraLike | undefined; webgpu: boolean }
  | { method: "picture"; frame: Frame; side: Side; kind: PictureKind; camera: CameraLike | undefined }
  | { method: "cloud"; frame: Frame; side: Side; kind: PictureKind; camera: CameraLike | undefined }
  | { method: "write"; result: Result; format: string; camera: CameraLike | undefined }
  | { method: "readSettings"; text: string }
  | { method: "writeSettings"; settings: Settings }
  | { method: "release"; held: (Frame | Result)[] };

export interface Reply {
  id: number;
  value?: unknown;
  error?: string;
}

const worker = new Worker(new URL("./worker.ts", import.meta.url), { type: "module" });
const waiting = new Map<number, { resolve(value: unknown): void; reject(error: Error): void }>();
let next = 0;

worker.onmessage = ({ data }: MessageEvent<Reply>) => {
  const call = waiting.get(data.id);
  waiting.delete(data.id);
  if (data.error === undefined) call?.resolve(data.value);
  else call?.reject(new Error(data.error));
};
worker.onerror = (event) => {
  const error = new Error(event.message || "the worker did not start: this browser may be too old");
  waiting.forEach(({ reject }) => reject(error));
  waiting.clear();
};

/** Sends a request to the worker, and returns its reply. */
export function ask<T>(call: Call): Promise<T> {
  const id = next++;
  const answered = new Promise<unknown>((resolve, reject) => waiting.set(id, { resolve, reject }));
  worker.postMessage({ id, call });
  return answered as Promise<T>;
}
