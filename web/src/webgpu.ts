// A host for planish's kernels on WebGPU. What to compile, bind and dispatch is planned by the module (crates/planish/src/gpu/plan.rs).

/** A plan of a frame. */
export interface Plan {
  plan: number;
  passes: { entry_point: string; wgsl: string; workgroups: [number, number] }[];
  uniform: number[];
  output_bytes: number;
  kept_bytes: [number, number];
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

/** Frames that may be in flight before `run` waits. */
const SLOTS = 3;

/** Kernels and buffers on a device. */
export class Gpu {
  private readonly pipelines = new Map<string, Promise<GPUComputePipeline>>();
  private readonly free: Slot[] = [];
  private open = 0;
  private readonly waiting: (() => void)[] = [];
  private readonly layout: GPUBindGroupLayout;
  private readonly pipelineLayout: GPUPipelineLayout;
  /** Why the device is lost, once it is. */
  lost: string | undefined;

  private constructor(
    private readonly device: GPUDevice,
    /** The name of the adapter. */
    readonly name: string,
    /** Whether it is a GPU in software, which is slower than the module. */
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

  /** Opens the adapter with all that it allows: the default of 16 KiB of workgroup memory is less than tiles need. `undefined` without WebGPU. */
  static async open(): Promise<Gpu | undefined> {
    const gpu = (globalThis.navigator as Navigator | undefined)?.gpu;
    const adapter = await gpu?.requestAdapter({ powerPreference: "high-performance" }).catch(() => null);
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

  /** Runs a plan on what it uploads and returns the bytes that its kernels wrote. */
  async run(plan: Plan, upload: Uint8Array<ArrayBuffer>): Promise<Uint8Array<ArrayBuffer>> {
    const pipelines = await Promise.all(plan.passes.map((pass) => this.pipeline(pass.entry_point, pass.wgsl)));
    const slot = await this.slot(plan, upload.length);
    try {
      const { device } = this;
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
      encoder.copyBufferToBuffer(slot.output, 0, slot.readback, 0, plan.output_bytes);
      device.queue.submit([encoder.finish()]);
      await slot.readback.mapAsync(GPUMapMode.READ, 0, plan.output_bytes);
      const result = new Uint8Array(slot.readback.getMappedRange(0, plan.output_bytes)).slice();
      slot.readback.unmap();
      return result;
    } finally {
      this.give(slot);
    }
  }

  /** Frees its buffers and the device. */
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
    return compiling;
  }

  private async slot(plan: Plan, inputBytes: number): Promise<Slot> {
    while (this.open >= SLOTS) await new Promise<void>((resolve) => this.waiting.push(resolve));
    this.open += 1;
    const key = [inputBytes, plan.output_bytes, ...plan.kept_bytes].join();
    const at = this.free.findIndex((slot) => slot.key === key);
    if (at >= 0) return this.free.splice(at, 1)[0]!;
    // Frames of another size: their buffers are in the way.
    this.free.splice(0).forEach(destroy);
    const buffer = (size: number, usage: number) => this.device.createBuffer({ size: Math.ceil(size / 4) * 4, usage });
    const { STORAGE, COPY_DST, COPY_SRC, UNIFORM, MAP_READ } = GPUBufferUsage;
    return {
      key,
      uniform: buffer(16, UNIFORM | COPY_DST),
      input: buffer(inputBytes, STORAGE | COPY_DST),
      output: buffer(plan.output_bytes, STORAGE | COPY_SRC),
      readback: buffer(plan.output_bytes, MAP_READ | COPY_DST),
      kept: [buffer(plan.kept_bytes[0], STORAGE), buffer(plan.kept_bytes[1], STORAGE)],
    };
  }

  private give(slot: Slot): void {
    this.open -= 1;
    if (this.lost === undefined) this.free.push(slot);
    this.waiting.shift()?.();
  }
}

function destroy(slot: Slot): void {
  [slot.uniform, slot.input, slot.output, slot.readback, ...slot.kept].forEach((buffer) => buffer.destroy());
}
