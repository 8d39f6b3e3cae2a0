//! NVRTC, CUDA's compiler as a library, loaded at run time. It is part of CUDA's toolkit and of PyTorch's package.

use std::ffi::{CStr, CString, c_char, c_int, c_void};
use std::path::PathBuf;
use std::ptr;

use libloading::Library;

use super::functions::functions;

/// Major versions of NVRTC, newest first, with their file names.
#[cfg(not(windows))]
const LIBRARIES: [(i32, &str); 3] = [(13, "libnvrtc.so.13"), (12, "libnvrtc.so.12"), (11, "libnvrtc.so.11.2")];
#[cfg(windows)]
const LIBRARIES: [(i32, &str); 3] = [(13, "nvrtc64_130_0.dll"), (12, "nvrtc64_120_0.dll"), (11, "nvrtc64_112_0.dll")];

/// Environment variables that, by CUDA's convention, contain the path of the CUDA toolkit.
const FOLDERS: [&str; 2] = ["CUDA_PATH", "CUDA_HOME"];

/// Folders of the library within the toolkit.
#[cfg(not(windows))]
const INSIDE: [&str; 2] = ["lib64", "lib"];
#[cfg(windows)]
const INSIDE: [&str; 2] = ["bin", "bin/x64"];

/// Compiler options. Divisions and roots may differ in the last bits, and denormals are flushed to zero, as in
/// Vulkan's drivers.
const OPTIONS: [&CStr; 6] = [
    c"--std=c++17",
    c"--device-as-default-execution-space",
    c"--ftz=true",
    c"--prec-div=false",
    c"--prec-sqrt=false",
    c"--disable-warnings",
];

/// A program handle of the library.
type Program = *mut c_void;

functions! {
    create = "nvrtcCreateProgram"(
        *mut Program, *const c_char, *const c_char, c_int, *const *const c_char, *const *const c_char
    );
    compile = "nvrtcCompileProgram"(Program, c_int, *const *const c_char);
    log_size = "nvrtcGetProgramLogSize"(Program, *mut usize);
    log = "nvrtcGetProgramLog"(Program, *mut c_char);
    cubin_size = "nvrtcGetCUBINSize"(Program, *mut usize);
    cubin = "nvrtcGetCUBIN"(Program, *mut c_char);
    ptx_size = "nvrtcGetPTXSize"(Program, *mut usize);
    ptx = "nvrtcGetPTX"(Program, *mut c_char);
    destroy = "nvrtcDestroyProgram"(*mut Program);
    count_archs = "nvrtcGetNumSupportedArchs"(*mut c_int);
    archs = "nvrtcGetSupportedArchs"(*mut c_int);
}

/// The compiler.
pub(super) struct Nvrtc {
    functions: Functions,
}

impl Nvrtc {
    /// Loads the newest library that compiles for GPUs of the given compute capability (90 for 9.0) and whose code
    /// the driver can run.
    pub(super) fn load(driver_major: i32, capability: i32) -> Result<Self, String> {
        let folders = FOLDERS.iter().filter_map(std::env::var_os).map(PathBuf::from);
        let folders: Vec<PathBuf> = folders.chain([PathBuf::from("/usr/local/cuda")]).collect();
        let mut unfit = String::new();
        for (_, name) in LIBRARIES.into_iter().filter(|(major, _)| *major <= driver_major) {
            let inside = |folder: &PathBuf| INSIDE.map(|inside| folder.join(inside).join(name));
            for path in [PathBuf::from(name)].into_iter().chain(folders.iter().flat_map(inside)) {
                // SAFETY: loading the library has no other effects.
                let Ok(library) = (unsafe { Library::new(&path) }) else { continue };
                match Functions::load(library, name).map(|functions| Self { functions }) {
                    Ok(nvrtc) if nvrtc.target(capability).is_some() => return Ok(nvrtc),
                    Ok(_) => unfit = format!("; {name} does not support GPUs of compute capability {capability}"),
                    Err(reason) => unfit = format!("; {reason}"),
                }
            }
        }
        let names = LIBRARIES.map(|(_, name)| name).join(", ");
        Err(format!(
            "no usable CUDA compiler was found ({names}, not newer than the driver{unfit}); install the CUDA toolkit \
             or set CUDA_PATH to its folder (in Python: `pip install nvidia-cuda-nvrtc-cu12`)"
        ))
    }

    /// Compiles a source for a GPU of the given compute capability: to machine code, or to PTX if the library does
    /// not know the GPU.
    pub(super) fn compile(&self, source: &str, capability: i32) -> Result<Vec<u8>, String> {
        let target = self.target(capability);
        let target = target.ok_or_else(|| format!("NVRTC does not support GPUs of compute capability {capability}"))?;
        let is_known = target == capability;
        let kind = if is_known { "sm" } else { "compute" };
        let architecture = CString::new(format!("--gpu-architecture={kind}_{target}")).map_err(|e| e.to_string())?;
        let options: Vec<*const c_char> =
            OPTIONS.iter().map(|option| option.as_ptr()).chain([architecture.as_ptr()]).collect();
        let source = CString::new(source).map_err(|error| error.to_string())?;
        let functions = &self.functions;
        let mut program = Held { functions, program: ptr::null_mut() };
        // SAFETY: all strings end in a zero and outlive the calls; buffers have the sizes that the library reports.
        unsafe {
            let name = c"planish.cu".as_ptr();
            check(
                (functions.create)(&mut program.program, source.as_ptr(), name, 0, ptr::null(), ptr::null()),
                "nvrtcCreateProgram",
            )?;
            if (functions.compile)(program.program, options.len() as c_int, options.as_ptr()) != 0 {
                let log = program.bytes(functions.log_size, functions.log)?;
                return Err(format!("NVRTC: {}", String::from_utf8_lossy(&log).trim_end_matches('\0')));
            }
            if is_known {
                program.bytes(functions.cubin_size, functions.cubin)
            } else {
                program.bytes(functions.ptx_size, functions.ptx)
            }
        }
    }

    /// Returns the compute capability to compile for: the GPU's, or the highest lower one that the library supports.
    fn target(&self, capability: i32) -> Option<i32> {
        self.architectures().into_iter().filter(|known| *known <= capability).max()
    }

    /// Returns the compute capabilities that the library compiles for.
    fn architectures(&self) -> Vec<i32> {
        let mut count = 0;
        // SAFETY: the buffer has the length that the library reports.
        unsafe {
            if (self.functions.count_archs)(&mut count) != 0 {
                return Vec::new();
            }
            let mut known = vec![0; count.max(0) as usize];
            if (self.functions.archs)(known.as_mut_ptr()) != 0 {
                return Vec::new();
            }
            known
        }
    }
}

/// A program, destroyed when dropped.
struct Held<'a> {
    functions: &'a Functions,
    program: Program,
}

type Size = unsafe extern "C" fn(Program, *mut usize) -> c_int;
type Copy = unsafe extern "C" fn(Program, *mut c_char) -> c_int;

impl Held<'_> {
    /// Returns an output of the program.
    fn bytes(&self, size: Size, copy: Copy) -> Result<Vec<u8>, String> {
        let mut len = 0;
        // SAFETY: the program is alive, and the buffer has the length that the library reports.
        unsafe {
            check(size(self.program, &mut len), "the size of NVRTC's output")?;
            let mut bytes = vec![0u8; len];
            check(copy(self.program, bytes.as_mut_ptr().cast()), "NVRTC's output")?;
            Ok(bytes)
        }
    }
}

impl Drop for Held<'_> {
    fn drop(&mut self) {
        if !self.program.is_null() {
            // SAFETY: the program is not used afterwards.
            unsafe { (self.functions.destroy)(&mut self.program) };
        }
    }
}

fn check(code: c_int, what: &str) -> Result<(), String> {
    if code == 0 { Ok(()) } else { Err(format!("{what}: NVRTC error {code}")) }
}
