//! The exports of the WebAssembly module: memory for requests, and one function that answers them.

use std::alloc::{Layout, alloc, dealloc};
use std::cell::RefCell;

use crate::page::Page;
use crate::request::Reply;

thread_local! {
    static PAGE: RefCell<Page> = RefCell::default();
    static REPLY: RefCell<(Vec<u8>, Vec<u8>)> = RefCell::default();
}

fn layout(len: usize) -> Option<Layout> {
    Layout::from_size_align(len.max(1), 8).ok()
}

/// Allocates `len` bytes; returns null on failure.
#[unsafe(no_mangle)]
pub extern "C" fn planish_alloc(len: usize) -> *mut u8 {
    match layout(len) {
        // SAFETY: the layout's size is not 0.
        Some(layout) => unsafe { alloc(layout) },
        None => std::ptr::null_mut(),
    }
}

/// Frees memory allocated by [`planish_alloc`].
///
/// # Safety
/// `at` must come from [`planish_alloc`] with the same `len`, and must not have been freed before.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn planish_free(at: *mut u8, len: usize) {
    if let Some(layout) = layout(len) {
        // SAFETY: by the contract of this function.
        unsafe { dealloc(at, layout) }
    }
}

/// Answers a request of JSON and bytes. The reply remains valid until the next call.
///
/// # Safety
/// `json` and `bytes` must be non-null and point to `json_len` and `bytes_len` initialized bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn planish_call(json: *const u8, json_len: usize, bytes: *const u8, bytes_len: usize) {
    // SAFETY: by the contract of this function.
    let (json, bytes) =
        unsafe { (std::slice::from_raw_parts(json, json_len), std::slice::from_raw_parts(bytes, bytes_len)) };
    let reply = match std::str::from_utf8(json) {
        Ok(request) => PAGE.with_borrow_mut(|session| session.handle(request, bytes)),
        Err(_) => Reply { error: Some("the request is not UTF-8".to_owned()), ..Reply::default() },
    };
    let json = serde_json::to_vec(&reply).unwrap_or_default();
    REPLY.set((json, reply.bytes));
}

/// Returns the address of part 0 (JSON) or 1 (bytes) of the reply.
#[unsafe(no_mangle)]
pub extern "C" fn planish_reply(part: usize) -> *const u8 {
    REPLY.with_borrow(|(json, bytes)| if part == 0 { json.as_ptr() } else { bytes.as_ptr() })
}

/// Returns the length in bytes of part 0 (JSON) or 1 (bytes) of the reply.
#[unsafe(no_mangle)]
pub extern "C" fn planish_reply_len(part: usize) -> usize {
    REPLY.with_borrow(|(json, bytes)| if part == 0 { json.len() } else { bytes.len() })
}

/// Frees the reply.
#[unsafe(no_mangle)]
pub extern "C" fn planish_reply_done() {
    REPLY.set(Default::default());
}
