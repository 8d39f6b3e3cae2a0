//! Translates a kernel to CUDA C++. naga translates WGSL to Metal's C++, and `metal.cuh` defines Metal's names for
//! CUDA's compiler. This module adapts only the entry point, the suffixes of float literals, and constants.

use std::fmt::Write;

use naga::back::msl;
use naga::valid::{Capabilities, ValidationFlags, Validator};

const METAL: &str = include_str!("metal.cuh");

/// Name of the entry point.
pub(super) const ENTRY_POINT: &str = "run";

/// The Metal slot of the buffer sizes, which kernels without bounds checks do not read.
const SIZES_SLOT: u8 = 30;

/// A kernel in CUDA C++. Its entry point is [`ENTRY_POINT`].
#[derive(Debug, PartialEq)]
pub(super) struct CudaSource {
    pub(super) text: String,
    /// The bindings of the kernel's parameters, in order. Binding 0 is the uniform, passed by value; the others are
    /// addresses.
    pub(super) bindings: Vec<u32>,
    /// Number of threads per block, across and down.
    pub(super) threads: [u32; 2],
}

/// Translates WGSL with one entry point.
pub(super) fn translate(wgsl: &str) -> Result<CudaSource, String> {
    let module = naga::front::wgsl::parse_str(wgsl).map_err(|error| error.emit_to_string(wgsl))?;
    let info = Validator::new(ValidationFlags::default(), Capabilities::empty()).validate(&module);
    let info = info.map_err(|error| error.emit_to_string(wgsl))?;
    let [entry] = &module.entry_points[..] else { return Err("a kernel has one entry point".into()) };
    let slots = module.global_variables.iter().filter_map(|(_, variable)| variable.binding);
    let slot = |binding: naga::ResourceBinding| {
        let target = msl::BindTarget { buffer: Some(binding.binding as u8), mutable: true, ..Default::default() };
        (binding, target)
    };
    let resources = msl::EntryPointResources {
        resources: slots.map(slot).collect(),
        sizes_buffer: Some(SIZES_SLOT),
        ..Default::default()
    };
    let options = msl::Options {
        lang_version: (2, 0),
        per_entry_point_map: [(entry.name.clone(), resources)].into(),
        fake_missing_bindings: false,
        zero_initialize_workgroup_memory: false,
        force_loop_bounding: false,
        ..Default::default()
    };
    let written = msl::write_string(&module, &info, &options, &msl::PipelineOptions::default());
    let (metal, _) = written.map_err(|error| error.to_string())?;
    let [across, down, _] = entry.workgroup_size;
    of_metal(&metal, [across, down])
}

/// Translates naga's Metal output to CUDA C++.
fn of_metal(metal: &str, threads: [u32; 2]) -> Result<CudaSource, String> {
    let unknown = |what: &str| format!("naga generated unexpected Metal code: {what}");
    let (before, entry) = metal.split_once("kernel void ").ok_or_else(|| unknown("no kernel"))?;
    let (name, entry) = entry.split_once('(').ok_or_else(|| unknown("a kernel without parameters"))?;
    let (parameters, body) = entry.split_once("\n) {").ok_or_else(|| unknown("parameters without an end"))?;

    let mut wrapper = Wrapper::default();
    let mut declarations = Vec::new();
    for line in parameters.lines().map(|line| line.trim_start_matches([',', ' '])).filter(|line| !line.is_empty()) {
        let (declaration, attribute) = line.split_once(" [[").unwrap_or((line, ""));
        wrapper.add(declaration, attribute.trim_end_matches("]]")).ok_or_else(|| unknown(line))?;
        declarations.push(declaration);
    }
    let mut text = format!("{METAL}\n");
    for line in before.lines().filter(|line| !line.starts_with("#include")) {
        match line.strip_prefix("constant ") {
            Some(constant) => text += &format!("static constexpr {}\n", with_suffixes(constant)),
            None => text += &format!("{}\n", with_suffixes(line)),
        }
    }
    let _ = writeln!(text, "kernel void {name}({}) {{{}", declarations.join(", "), with_suffixes(body));
    let Wrapper { parameters, variables, arguments, bindings } = wrapper;
    let _ = writeln!(
        text,
        "extern \"C\" __global__ void __launch_bounds__({}) {ENTRY_POINT}({}) {{\n{variables}    {name}({});\n}}",
        threads[0] * threads[1],
        parameters.join(", "),
        arguments.join(", ")
    );
    Ok(CudaSource { text, bindings, threads })
}

/// The parts of the CUDA kernel that calls Metal's kernel.
#[derive(Default)]
struct Wrapper {
    /// Parameters of the CUDA kernel.
    parameters: Vec<String>,
    /// Declarations in the body of the CUDA kernel.
    variables: String,
    /// Arguments passed to Metal's kernel.
    arguments: Vec<String>,
    bindings: Vec<u32>,
}

impl Wrapper {
    /// Adds a parameter of Metal's kernel. Returns `None` if its kind is unknown.
    fn add(&mut self, declaration: &str, attribute: &str) -> Option<()> {
        let name = declaration.split(' ').next_back()?;
        let kind = declaration.strip_suffix(name)?.trim_end();
        let of_device = |kind: &str| kind.strip_suffix('&').map(|kind| kind.trim_end().to_owned());
        self.arguments.push(match attribute {
            "threadgroup_position_in_grid" => "metal::uint3(blockIdx.x, blockIdx.y, blockIdx.z)".into(),
            "thread_position_in_threadgroup" => "metal::uint3(threadIdx.x, threadIdx.y, threadIdx.z)".into(),
            "thread_index_in_threadgroup" => "threadIdx.y * blockDim.x + threadIdx.x".into(),
            "" => {
                let kind = of_device(kind.strip_prefix("threadgroup ")?)?;
                self.variables += &format!("    __shared__ {kind} {name};\n");
                name.into()
            }
            _ => {
                let slot = attribute.strip_prefix("buffer(")?.strip_suffix(')')?.parse().ok()?;
                if slot == u32::from(SIZES_SLOT) {
                    self.variables += &format!("    {} {name} = {{}};\n", of_device(kind.strip_prefix("constant ")?)?);
                    name.into()
                } else if let Some(kind) = kind.strip_prefix("constant ") {
                    self.parameters.push(format!("const {} {name}", of_device(kind)?));
                    self.bindings.push(slot);
                    name.into()
                } else {
                    let kind = of_device(kind.strip_prefix("device ")?)?;
                    self.parameters.push(format!("{kind} *__restrict__ {name}"));
                    self.bindings.push(slot);
                    format!("*{name}")
                }
            }
        });
        Some(())
    }
}

/// Appends `f` to float literals, which would otherwise be doubles.
fn with_suffixes(metal: &str) -> String {
    let mut text = String::with_capacity(metal.len() + metal.len() / 16);
    let mut rest = metal;
    let is_of_word = |c: char| c.is_ascii_alphanumeric() || c == '_';
    while let Some(c) = rest.chars().next() {
        let end_of_word = rest.find(|c| !is_of_word(c)).unwrap_or(rest.len());
        let (token, is_float) = if c.is_ascii_digit() {
            let after =
                rest[end_of_word..].strip_prefix('.').filter(|digits| digits.starts_with(|c: char| c.is_ascii_digit()));
            match after {
                Some(digits) => {
                    let end = digits.find(|c| !is_of_word(c)).unwrap_or(digits.len());
                    (&rest[..end_of_word + 1 + end], true)
                }
                None => (&rest[..end_of_word], false),
            }
        } else if is_of_word(c) {
            (&rest[..end_of_word], false)
        } else {
            (&rest[..c.len_utf8()], false)
        };
        text += token;
        if is_float {
            text.push('f');
        }
        rest = &rest[token.len()..];
    }
    text
}
