// The host of planish's kernels on WebGPU. The module plans what to compile, bind and dispatch
// (crates/planish-core/src/gpu/plan.rs).

/** The plan of a frame: its kernels, uniform and buffer sizes. */
export interface Plan {
  plan: number;
  passes: { entryPoint: string; wgsl: string; workgroups: [number, number] }[];
  uniform: number[];
  outputBytes: number;
  keptBytes: [number, number];
}

/** The buffers of a frame in flight. */
interface Slot {
  key: string;
  uniform: GPUBuffer;
  input: GPUBuffer;
  output: GPUBuffer;
  readback: GPUBuffer;
  kept: [GPUBuffer, GPUBuffer];
}

/** Maximum number of frames in flight; `run` waits for a free slot. */
const SLOTS = 3;

/** Maximum time to wait for an adapter, in milliseconds. */
const PATIENCE_MS = 5000;

/** An error for a frame that exceeds the device's memory; smaller frames still work. */
export class FrameTooLarge extends Error {}

/** Kernels and buffers on a device. */
export class Gpu {
  private readonly pipelines = new Map<string, Promise<GPUComputePipeline>>();
  private readonly free: Slot[] = [];
  private open = 0;
  private readonly waiting: (() => void)[] = [];
  private readonly layout: GPUBindGroupLayout;
  private readonly pipelineLayout: GPUPipelineLayout;
  /** Reason why the device was lost, or `undefined` if it was not lost. */
  lost: string | undefined;

  private constructor(
    private readonly device: GPUDevice,
    /** The name of the adapter. */
    readonly name: string,
    /** Whether the adapter is a software GPU, which is slower than the module. */
    readonly isSoftware: boolean,
  ) {
    const types: GPUBufferBindingType[] = ["uniform", "read-only-storage", "storage", "storage", "storage"];
    this.layout = device.createBindGroupLayout({
      entries: types.map((type, binding) => ({ binding, visibility: GPUShaderStage.COMPUTE, buffer: { type } })),
    });
    this.pipelineLayout = device.createPipelineLayout({ bindGroupLayouts: [this.layout] });
    void device.lost.then((info) => {
      this.lost = info.message || info.reason;
    });
  }

  /**
   * Opens the adapter with its maximum limits, since tiles need more than the default of 16 KiB of workgroup memory.
   * Returns `undefined` without WebGPU.
   */
  static async open(): Promise<Gpu | undefined> {
    const gpu = (globalThis.navigator as Navigator | undefined)?.gpu;
    if (!gpu) return undefined;
    let timer: ReturnType<typeof setTimeout> | undefined;
    const tooLate = new Promise<undefined>((resolve) => (timer = setTimeout(() => resolve(undefined), PATIENCE_MS)));
    const adapter = await Promise.race([gpu.requestAdapter({ powerPreference: "high-performance" }).catch(() => null), tooLate]);
    clearTimeout(timer);
    if (!adapter) return undefined;
    const { maxComputeWorkgroupStorageSize, maxStorageBufferBindingSize, maxBufferSize } = adapter.limits;
    const device = await adapter.requestDevice({
      requiredLimits: { maxComputeWorkgroupStorageSize, maxStorageBufferBindingSize, maxBufferSize },
    });
    const { description, vendor, architecture, isFallbackAdapter } = adapter.info;
    const name = description || [vendor, architecture].filter(Boolean).join(" ") || "GPU";
    return new Gpu(device, name, isFallbackAdapter || architecture === "swiftshader");
  }

  /** The limits that plans depend on. */
  get limits(): [number, number, number] {
    const { maxComputeWorkgroupStorageSize, maxStorageBufferBindingSize, maxBufferSize, maxComputeWorkgroupsPerDimension } =
      this.device.limits;
    return [maxComputeWorkgroupStorageSize, Math.min(maxStorageBufferBindingSize, maxBufferSize), maxComputeWorkgroupsPerDimension];
  }

  /** Uploads a plan's data, runs its kernels, and returns their output. */
  async run(plan: Plan, upload: Uint8Array<ArrayBuffer>): Promise<Uint8Array<ArrayBuffer>> {
    const pipelines = await Promise.all(plan.passes.map((pass) => this.pipeline(pass.entryPoint, pass.wgsl)));
    const { device } = this;
    const slot = await this.slot(plan, upload.length);
    let isWhole = false;
    try {
      device.queue.writeBuffer(slot.uniform, 0, new Uint32Array(plan.uniform));
      device.queue.writeBuffer(slot.input, 0, upload);
      const bound = [slot.uniform, slot.input, slot.output, ...slot.kept];
      const bindGroup = device.createBindGroup({
        layout: this.layout,
        entries: bound.map((buffer, binding) => ({ binding, resource: { buffer } })),
      });
      const encoder = device.createCommandEncoder();
      const pass = encoder.beginComputePass();
      pass.setBindGroup(0, bindGroup);
      plan.passes.forEach(({ workgroups: [across, down] }, i) => {
        pass.setPipeline(pipelines[i]!);
        pass.dispatchWorkgroups(across, down);
      });
      pass.end();
      encoder.copyBufferToBuffer(slot.output, 0, slot.readback, 0, plan.outputBytes);
      device.queue.submit([encoder.finish()]);
      await slot.readback.mapAsync(GPUMapMode.READ, 0, plan.outputBytes);
      const result = new Uint8Array(slot.readback.getMappedRange(0, plan.outputBytes)).slice();
      slot.readback.unmap();
      isWhole = true;
      return result;
    } finally {
      if (isWhole) this.free.push(slot);
      else destroy(slot);
      this.leave();
    }
  }

  /** Returns whether the device is lost. Waits briefly, since a pending call may fail before `lost` resolves. */
  async isLost(): Promise<boolean> {
    await Promise.race([this.device.lost, after(100)]);
    return this.lost !== undefined;
  }

  /** Frees the device and its buffers. */
  close(): void {
    this.device.destroy();
  }

  private pipeline(entryPoint: string, wgsl: string): Promise<GPUComputePipeline> {
    const known = this.pipelines.get(wgsl);
    if (known) return known;
    const compiling = this.device.createComputePipelineAsync({
      layout: this.pipelineLayout,
      compute: { module: this.device.createShaderModule({ code: wgsl }), entryPoint },
    });
    this.pipelines.set(wgsl, compiling);
    // Allow a failed compilation to be tried again.
    compiling.catch(() => this.pipelines.delete(wgsl));
    return compiling;
  }

  private async slot(plan: Plan, inputBytes: number): Promise<Slot> {
    while (this.open >= SLOTS) await new Promise<void>((resolve) => this.waiting.push(resolve));
    this.open += 1;
    try {
      return await this.buffers(plan, inputBytes);
    } catch (error) {
      this.leave();
      throw error;
    }
  }

  /** Returns buffers for a plan. Checks for errors, since buffers whose creation failed would read as zeros. */
  private async buffers(plan: Plan, inputBytes: number): Promise<Slot> {
    const key = [inputBytes, plan.outputBytes, ...plan.keptBytes].join();
    const at = this.free.findIndex((slot) => slot.key === key);
    if (at >= 0) return this.free.splice(at, 1)[0]!;
    // Free buffers that were created for frames of other sizes.
    this.free.splice(0).forEach(destroy);
    const { device } = this;
    const buffer = (size: number, usage: number) => device.createBuffer({ size: Math.ceil(size / 4) * 4, usage });
    const { STORAGE, COPY_DST, COPY_SRC, UNIFORM, MAP_READ } = GPUBufferUsage;
    device.pushErrorScope("validation");
    device.pushErrorScope("out-of-memory");
    const slot = {
      key,
      uniform: buffer(16, UNIFORM | COPY_DST),
      input: buffer(inputBytes, STORAGE | COPY_DST),
      output: buffer(plan.outputBytes, STORAGE | COPY_SRC),
      readback: buffer(plan.outputBytes, MAP_READ | COPY_DST),
      kept: [buffer(plan.keptBytes[0], STORAGE), buffer(plan.keptBytes[1], STORAGE)],
    } satisfies Slot;
    const errors = await Promise.all([device.popErrorScope(), device.popErrorScope()]);
    const error = errors.find((error) => error !== null);
    if (!error) return slot;
    destroy(slot);
    throw new FrameTooLarge(error.message);
  }

  /** Frees a slot, and resumes the next waiting frame. */
  private leave(): void {
    this.open -= 1;
    this.waiting.shift()?.();
  }
}

function after(milliseconds: number): Promise<undefined> {
  return new Promise((resolve) => setTimeout(() => resolve(undefined), milliseconds));
}

function destroy(slot: Slot): void {
  [slot.uniform, slot.input, slot.output, slot.readback, ...slot.kept].forEach((buffer) => buffer.destroy());
}
