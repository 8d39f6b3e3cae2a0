//! `planish view`: shows a frame or cloud in the browser, raw and smoothed. This process serves the page of `web/`.

use crate::exit::ExitCode;
use std::collections::hash_map::RandomState;
use std::fmt::Write as _;
use std::hash::{BuildHasher, Hasher};
use std::io::{Read, Write};
use std::net::{Ipv4Addr, TcpListener, TcpStream};
use std::path::{Component, Path};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use planish::io::{self, CloudRef, Contents, Encoding, FileRead, Format};
use planish_bench::outln;

use super::checks::report_notes;
use super::{check_work, organized, read_input};
use crate::args::ViewArgs;
use crate::signals::stop_flag;

/// Files of the page: paths relative to its folder, and contents. Empty if this build does not contain the page.
const PAGE: &[(&str, &[u8])] = include!(concat!(env!("OUT_DIR"), "/page.rs"));

/// Maximum time to receive a request, which comes from this machine.
const REQUEST_PATIENCE: Duration = Duration::from_secs(1);
/// Maximum time for each write of a response.
const PATIENCE: Duration = Duration::from_secs(5);

/// Maximum size of a request in bytes.
const LONGEST_REQUEST: usize = 16 << 10;

/// Maximum number of simultaneous requests; a browser opens about six connections.
const MOST_REQUESTS: usize = 32;

/// Lifetime of a ticket: the maximum time that the browser may take to start.
const TICKET_LIFE: Duration = Duration::from_secs(60);

/// Interval between checks for a connection or a signal.
const LOOK: Duration = Duration::from_millis(50);

/// The served files and the state of the server.
struct Served {
    /// Names and contents of the page's files, the frame and its camera.
    files: Vec<(String, Vec<u8>)>,
    /// Random first component of every path, so that other users cannot guess the addresses of the files.
    token: String,
    /// A one-time path for the browser that this process starts, and its expiry. Other users can see the command line
    /// of the browser, so it must not contain the token.
    ticket: Mutex<Option<(String, Instant)>>,
    /// Fragment of the page's address, with the names of the frame and its camera.
    shown: String,
    /// Number of requests in progress.
    requests: AtomicUsize,
}

impl Served {
    fn new(files: Vec<(String, Vec<u8>)>, shown: String) -> Self {
        Self { files, token: token(), ticket: Mutex::new(None), shown, requests: AtomicUsize::new(0) }
    }

    /// Issues a path that redirects to the page once.
    fn new_ticket(&self) -> String {
        let ticket = token();
        let end = Instant::now() + TICKET_LIFE;
        *self.ticket.lock().unwrap_or_else(PoisonError::into_inner) = Some((ticket.clone(), end));
        ticket
    }

    /// Returns the page's address if `path` is the ticket, and invalidates the ticket.
    fn redeem(&self, path: &str) -> Option<String> {
        let mut ticket = self.ticket.lock().unwrap_or_else(PoisonError::into_inner);
        let redeemed = ticket.take_if(|(ticket, _)| path.strip_prefix('/') == Some(ticket));
        redeemed.filter(|(_, end)| Instant::now() < *end).map(|_| format!("/{}/#{}", self.token, self.shown))
    }
}

pub fn run(args: &ViewArgs) -> Result<ExitCode> {
    let mut files = page(args.page.as_deref())?;
    let (file, camera) = read_input(&args.file, &args.reading.read_options(), &args.camera)?;
    let FileRead { contents, notes, .. } = file;
    report_notes(&args.file, &notes);
    let camera_of_depth = if contents.is_depth() { camera.camera(contents.shape())? } else { None };
    let of_file = || args.file.display().to_string();
    let stem = args.file.file_stem().unwrap_or_default().to_string_lossy();
    check_work(io::Work::Encode, &contents, &args.reading.read_options(), &args.file)?;
    // The page reads fewer formats than the command.
    let (extension, bytes) = match contents {
        Contents::Depth(image) => ("png", io::encode_depth(Format::DepthPng, &image)),
        Contents::General(cloud) => ("pcd", io::encode_cloud(Format::Pcd, CloudRef::General(&cloud), Encoding::Binary)),
        contents => {
            let cloud = organized(contents, &camera, &args.file)?;
            ("pcd", io::encode_cloud(Format::Pcd, CloudRef::Organized(&cloud), Encoding::Binary))
        }
    };
    let mut shown = format!("{}.{extension}", escaped(&stem));
    files.push((shown.clone(), bytes.with_context(of_file)?));
    if let Some(camera) = camera_of_depth {
        shown.push_str(",camera.json");
        files.push(("camera.json".to_owned(), io::camera_to_json(&camera).into_bytes()));
    }

    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, args.port))
        .with_context(|| format!("--port {}: cannot listen on 127.0.0.1", args.port))?;
    let port = listener.local_addr()?.port();
    let served = Arc::new(Served::new(files, shown));
    let address = format!("http://127.0.0.1:{port}/{}/#{}", served.token, served.shown);
    let stop = stop_flag();
    outln!("{address}");
    outln!("  data stays on this machine; press Ctrl-C to stop");
    if std::env::var_os("SSH_CONNECTION").is_some() {
        outln!("  from your own machine: ssh -L {port}:127.0.0.1:{port} HOST, then open the address there");
    } else if !args.no_browser {
        open_browser(&format!("http://127.0.0.1:{port}/{}", served.new_ticket()));
    }
    serve(&listener, &served, &stop)
}

/// Returns the files of the page.
fn page(folder: Option<&Path>) -> Result<Vec<(String, Vec<u8>)>> {
    let Some(folder) = folder else {
        if PAGE.is_empty() {
            bail!(
                "this build does not contain the page; build it with `web/build-page` and add --page web/dist-page, or \
                 install a packaged planish, which includes it"
            );
        }
        return Ok(PAGE.iter().map(|(name, bytes)| ((*name).to_owned(), bytes.to_vec())).collect());
    };
    let mut files = Vec::new();
    let mut folders = vec![folder.to_path_buf()];
    while let Some(next) = folders.pop() {
        for entry in std::fs::read_dir(&next).with_context(|| format!("--page {}", next.display()))? {
            let path = entry?.path();
            if path.is_dir() {
                folders.push(path);
                continue;
            }
            let below = path.strip_prefix(folder).unwrap_or(&path).components();
            let names: Vec<_> = below
                .filter_map(|part| match part {
                    Component::Normal(name) => Some(name.to_string_lossy()),
                    _ => None,
                })
                .collect();
            files.push((names.join("/"), std::fs::read(&path).with_context(|| path.display().to_string())?));
        }
    }
    if !files.iter().any(|(name, _)| name == "index.html") {
        bail!("--page {}: index.html not found; pass the folder built by `web/build-page`", folder.display());
    }
    Ok(files)
}

/// Returns 128 random bits in hexadecimal. They come from the seeds of the standard library's hash tables, which the
/// system provides.
fn token() -> String {
    let bits = || RandomState::new().build_hasher().finish();
    format!("{:016x}{:016x}", bits(), bits())
}

/// Percent-encodes a name for a URL.
fn escaped(name: &str) -> String {
    name.bytes().fold(String::new(), |mut text, byte| {
        match byte {
            b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' | b'-' | b'_' | b'.' => text.push(byte.into()),
            byte => _ = write!(text, "%{byte:02X}"),
        }
        text
    })
}

fn open_browser(address: &str) {
    let (program, arguments): (&str, &[&str]) = match std::env::consts::OS {
        "macos" => ("open", &[]),
        "windows" => ("rundll32", &["url.dll,FileProtocolHandler"]),
        _ if ["DISPLAY", "WAYLAND_DISPLAY"].iter().all(|name| std::env::var_os(name).is_none()) => return,
        _ => ("xdg-open", &[]),
    };
    let mut command = Command::new(program);
    command.args(arguments).arg(address).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    // Ctrl-C ends the server, not the browser.
    #[cfg(unix)]
    std::os::unix::process::CommandExt::process_group(&mut command, 0);
    // Failure is fine: the address is printed.
    if let Ok(mut started) = command.spawn() {
        let _ = std::thread::Builder::new().spawn(move || started.wait());
    }
}

/// Answers requests until `stop` is set.
fn serve(listener: &TcpListener, served: &Arc<Served>, stop: &AtomicBool) -> Result<ExitCode> {
    listener.set_nonblocking(true)?;
    while !stop.load(Ordering::Relaxed) {
        match listener.accept() {
            // Too many requests: the connection is closed, and the browser tries again.
            Ok(_) if served.requests.load(Ordering::Relaxed) >= MOST_REQUESTS => {}
            Ok((stream, _)) => {
                served.requests.fetch_add(1, Ordering::Relaxed);
                let shared = Arc::clone(served);
                let work = move || {
                    let _ = answer(stream, &shared);
                    shared.requests.fetch_sub(1, Ordering::Relaxed);
                };
                if std::thread::Builder::new().spawn(work).is_err() {
                    served.requests.fetch_sub(1, Ordering::Relaxed);
                }
            }
            // No connection, one that was closed again, or too many open files.
            Err(_) => std::thread::sleep(LOOK),
        }
    }
    Ok(ExitCode::SUCCESS)
}

/// Answers one request. Only GET requests for a file below the token, or for the ticket, succeed.
fn answer(mut stream: TcpStream, served: &Served) -> std::io::Result<()> {
    stream.set_nonblocking(false)?;
    stream.set_write_timeout(Some(PATIENCE))?;
    let (mut request, deadline) = (Vec::new(), Instant::now() + REQUEST_PATIENCE);
    while !request.windows(4).any(|end| end == b"\r\n\r\n") && request.len() < LONGEST_REQUEST {
        let left = deadline.saturating_duration_since(Instant::now());
        if left.is_zero() {
            return Ok(());
        }
        stream.set_read_timeout(Some(left))?;
        let mut buffer = [0; 1024];
        match stream.read(&mut buffer)? {
            0 => break,
            read => request.extend_from_slice(&buffer[..read]),
        }
    }
    let request = String::from_utf8_lossy(&request);
    let mut words = request.lines().next().unwrap_or_default().split(' ');
    let (method, path) = (words.next().unwrap_or_default(), words.next().unwrap_or_default());
    let below = path.strip_prefix('/').and_then(|path| path.strip_prefix(&*served.token)?.strip_prefix('/'));
    let name = below.map(|name| if name.is_empty() { "index.html" } else { name });
    let found = name.and_then(|name| served.files.iter().find(|(file, _)| file == name));
    let page = if method == "GET" && is_own(&stream) { served.redeem(path) } else { None };
    let (status, kind, body) = match (method, found) {
        _ if page.is_some() => ("302 Found", "text/plain", &[][..]),
        ("GET", Some((name, body))) => ("200 OK", kind_of(name), &body[..]),
        ("GET", None) => ("404 Not Found", "text/plain", &b"not found\n"[..]),
        _ => ("405 Method Not Allowed", "text/plain", &b"only GET\n"[..]),
    };
    let location = page.map_or(String::new(), |page| format!("Location: {page}\r\n"));
    write!(
        stream,
        "HTTP/1.1 {status}\r\n{location}Content-Type: {kind}\r\nContent-Length: {}\r\nCache-Control: no-store\r\n\
         Referrer-Policy: no-referrer\r\nX-Content-Type-Options: nosniff\r\nX-Frame-Options: DENY\r\n\
         Cross-Origin-Resource-Policy: same-origin\r\nConnection: close\r\n\r\n",
        body.len()
    )?;
    stream.write_all(body)
}

/// Returns false if the process at the other end of a connection is known to belong to another user.
#[cfg(target_os = "linux")]
fn is_own(stream: &TcpStream) -> bool {
    use std::os::unix::fs::MetadataExt;
    let user_of_peer = || -> Option<u32> {
        let peer = stream.peer_addr().ok()?;
        // The address as a hexadecimal number in native byte order, and the port.
        let address = format!("{:08X}:{:04X}", u32::from_ne_bytes(Ipv4Addr::LOCALHOST.octets()), peer.port());
        let connections = std::fs::read_to_string("/proc/net/tcp").ok()?;
        let fields = connections.lines().map(|line| line.split_whitespace().collect::<Vec<_>>());
        fields.into_iter().find(|fields| fields.get(1) == Some(&&*address))?.get(7)?.parse().ok()
    };
    let own = std::fs::metadata("/proc/self").map(|process| process.uid());
    user_of_peer().zip(own.ok()).is_none_or(|(peer, own)| peer == own)
}

#[cfg(not(target_os = "linux"))]
fn is_own(_: &TcpStream) -> bool {
    true
}

fn kind_of(name: &str) -> &'static str {
    match name.rsplit('.').next() {
        Some("html") => "text/html; charset=utf-8",
        Some("js") => "text/javascript",
        Some("css") => "text/css",
        Some("wasm") => "application/wasm",
        Some("json") => "application/json",
        Some("svg") => "image/svg+xml",
        Some("png") => "image/png",
        _ => "application/octet-stream",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_request_gets_what_is_below_the_token_and_nothing_else() {
        let files = vec![("index.html".to_owned(), b"page".to_vec()), ("a%20b.pcd".to_owned(), b"points".to_vec())];
        let served = Arc::new(Served::new(files, "a.pcd".to_owned()));
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        let address = listener.local_addr().unwrap();
        let ask = |request: &str| {
            let mut stream = TcpStream::connect(address).unwrap();
            stream.write_all(request.as_bytes()).unwrap();
            answer(listener.accept().unwrap().0, &served).unwrap();
            let mut text = String::new();
            stream.read_to_string(&mut text).unwrap();
            text
        };
        let token = &served.token;
        assert_eq!(token.len(), 32);
        assert!(ask(&format!("GET /{token}/ HTTP/1.1\r\n\r\n")).ends_with("\r\n\r\npage"));
        let points = ask(&format!("GET /{token}/{}.pcd HTTP/1.1\r\nHost: x\r\n\r\n", escaped("a b")));
        assert!(points.starts_with("HTTP/1.1 200 OK\r\n") && points.ends_with("points"), "{points}");
        for request in ["GET / HTTP/1.1\r\n\r\n", "GET /index.html HTTP/1.1\r\n\r\n", "\r\n\r\n", "GET\r\n\r\n"] {
            let text = ask(request);
            assert!(!text.contains("page") && text.starts_with("HTTP/1.1 40"), "{text}");
        }
        assert!(ask(&format!("GET /{token}/../index.html HTTP/1.1\r\n\r\n")).starts_with("HTTP/1.1 404"));
        assert!(ask(&format!("POST /{token}/ HTTP/1.1\r\n\r\n")).starts_with("HTTP/1.1 405"));
        // A ticket redirects to the page once.
        let ticket = served.new_ticket();
        assert!(ask(&format!("POST /{ticket} HTTP/1.1\r\n\r\n")).starts_with("HTTP/1.1 405"));
        let page = ask(&format!("GET /{ticket} HTTP/1.1\r\n\r\n"));
        assert!(page.starts_with(&format!("HTTP/1.1 302 Found\r\nLocation: /{token}/#a.pcd\r\n")), "{page}");
        assert!(ask(&format!("GET /{ticket} HTTP/1.1\r\n\r\n")).starts_with("HTTP/1.1 404"));
    }
}
