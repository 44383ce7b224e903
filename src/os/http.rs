//! Requests and answers of HTTP/1.1, as far as a page of this program needs them.

use std::io::{self, Read, Write};
use std::net::{Shutdown, TcpStream};
use std::time::{Duration, Instant};

/// The most bytes of the head of a request, and of its body.
const LONGEST_HEAD: usize = 8192;
const LONGEST_BODY: usize = 4096;

/// How long a request may take, and how long an answer may make no progress.
pub const PATIENCE: Duration = Duration::from_secs(5);

/// How long and how much is read of a request that is refused, so that the answer is not lost.
const LINGER: Duration = Duration::from_millis(500);
const MOST_LINGERED: usize = 1 << 16;

/// A request whose head and body have arrived whole.
pub struct Request {
    pub method: String,
    target: String,
    /// The end of its path: a proxy may leave its own path before it.
    pub name: String,
    headers: Vec<(String, String)>,
    pub body: Vec<u8>,
}

/// A status, without the protocol and with the header lines that belong to it, and a sentence.
pub type Refusal = (&'static str, &'static str);

const MALFORMED: Refusal = ("400 Bad Request", "This is not a request by HTTP/1.1.");

impl Request {
    /// Reads a request.
    ///
    /// # Errors
    /// Fails with the answer to send.
    pub fn read(stream: &mut TcpStream) -> Result<Self, Refusal> {
        let deadline = Instant::now() + PATIENCE;
        let mut bytes = Vec::new();
        let end = loop {
            read_some(stream, &mut bytes, LONGEST_HEAD, deadline)?;
            if let Some(end) = bytes.windows(4).position(|four| four == b"\r\n\r\n") {
                break end + 4;
            }
            if bytes.len() >= LONGEST_HEAD {
                return Err((
                    "431 Request Header Fields Too Large",
                    "The request is too long.",
                ));
            }
        };
        let body = bytes.split_off(end);
        let mut request = Self::parse(&bytes).ok_or(MALFORMED)?;
        if request.method == "POST" {
            request.body = body;
            let length = request.length()?;
            while request.body.len() < length {
                read_some(stream, &mut request.body, length, deadline)?;
            }
            request.body.truncate(length);
        }
        Ok(request)
    }

    fn parse(head: &[u8]) -> Option<Self> {
        let mut lines = std::str::from_utf8(head)
            .ok()?
            .trim_end_matches("\r\n")
            .split("\r\n");
        let [method, target, version] = Vec::from_iter(lines.next()?.split(' ')).try_into().ok()?;
        let (_, name) = target.split('?').next()?.rsplit_once('/')?;
        let header = |line: &str| {
            let (name, value) = line.split_once(':')?;
            let is_name = !name.is_empty() && name.bytes().all(|c| c.is_ascii_graphic());
            is_name.then(|| (name.to_ascii_lowercase(), value.trim().to_owned()))
        };
        let headers = lines.map(header).collect::<Option<_>>()?;
        let fits = target.starts_with('/') && version.starts_with("HTTP/1.");
        fits.then(|| Self {
            method: method.into(),
            target: target.into(),
            name: name.into(),
            headers,
            body: Vec::new(),
        })
    }

    /// The value of a header, or an empty one if it is there more than once.
    fn header(&self, name: &str) -> Option<&str> {
        let mut found = self.headers.iter().filter(|(own, _)| own == name);
        let (_, value) = found.next()?;
        Some(if found.next().is_none() { value } else { "" })
    }

    /// The length of the body in bytes.
    fn length(&self) -> Result<usize, Refusal> {
        let digits = self
            .header("content-length")
            .filter(|text| !text.is_empty() && text.bytes().all(|c| c.is_ascii_digit()))
            .filter(|_| self.header("transfer-encoding").is_none())
            .ok_or((
                "411 Length Required",
                "The length of the body is not given.",
            ))?;
        let length = digits.parse().ok().filter(|length| *length <= LONGEST_BODY);
        length.ok_or(("413 Content Too Large", "The body is too long."))
    }

    /// Checks that the address in the browser belongs to this machine, or has this `host`, the name of a proxy: another host name may
    /// have been made to lead here. It must have the token, if there is one.
    ///
    /// # Errors
    /// Fails with the answer to send.
    pub fn expect_known(&self, host: &str, token: &str) -> Result<(), Refusal> {
        let asked = self.header("host").unwrap_or_default();
        let name = match asked.rsplit_once(':') {
            Some((name, port)) if port.bytes().all(|c| c.is_ascii_digit()) => name,
            _ => asked,
        };
        let is_known = ["localhost", "127.0.0.1", "[::1]", host]
            .iter()
            .any(|known| name.eq_ignore_ascii_case(known));
        let sentence = "Only the address that the program has printed is answered: at localhost, 127.0.0.1, [::1] or the name of --web-host.";
        (is_known && self.target.contains(token))
            .then_some(())
            .ok_or(("403 Forbidden", sentence))
    }

    /// Checks that the page or its user asks, and not a page of another origin in the same browser. A request that is `proxied` does
    /// not have the host that the browser has asked.
    ///
    /// # Errors
    /// Fails with the answer to send.
    pub fn expect_own(&self, proxied: bool) -> Result<(), Refusal> {
        // This content type makes a browser ask before it sends the request from another origin. Such a question is not answered.
        let is_json = self
            .header("content-type")
            .is_some_and(|kind| kind.split(';').next() == Some("application/json"));
        let reads = self.method == "GET";
        let is_own = match (self.header("sec-fetch-site"), self.header("origin")) {
            (Some(site), _) => ["same-origin", "none"].contains(&site),
            (None, Some(origin)) => proxied || origin.split("://").nth(1) == self.header("host"),
            // A page that sends says where it is from.
            (None, None) => reads,
        };
        (is_own && (reads || is_json))
            .then_some(())
            .ok_or(("403 Forbidden", "Only the page itself may ask for this."))
    }
}

/// Reads what has arrived, so that there are at most `most` bytes.
///
/// # Errors
/// Fails with the answer to send if nothing arrives any more.
fn read_some(
    stream: &mut TcpStream,
    bytes: &mut Vec<u8>,
    most: usize,
    deadline: Instant,
) -> Result<(), Refusal> {
    let late = ("408 Request Timeout", "The request took too long.");
    let left = deadline.saturating_duration_since(Instant::now());
    if left.is_zero() || stream.set_read_timeout(Some(left)).is_err() {
        return Err(late);
    }
    let mut part = [0; 1024];
    let room = part.len().min(most - bytes.len());
    match stream.read(&mut part[..room]) {
        Ok(0) => return Err(MALFORMED),
        Ok(count) => bytes.extend(&part[..count]),
        Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
        Err(_) => return Err(late),
    }
    Ok(())
}

/// The head of an answer that is not cached, and is not shown inside another page.
pub fn head(status: &str, more: &[&str]) -> String {
    let always = [
        "Cache-Control: no-store",
        "X-Content-Type-Options: nosniff",
        "X-Frame-Options: DENY",
        "Cross-Origin-Resource-Policy: same-origin",
        "Referrer-Policy: no-referrer",
        "Connection: close",
    ];
    format!(
        "HTTP/1.1 {status}\r\n{}\r\n\r\n",
        [&always, more].concat().join("\r\n")
    )
}

/// Answers with a text of this type.
///
/// # Errors
/// Fails if the other side does not read it.
pub fn answer(stream: &mut TcpStream, status: &str, kind: &str, text: &str) -> io::Result<()> {
    let about = [
        format!("Content-Length: {}", text.len()),
        format!("Content-Type: {kind}; charset=utf-8"),
    ];
    stream.write_all((head(status, &about.each_ref().map(String::as_str)) + text).as_bytes())
}

/// Answers with a refusal. What the other side still sends is read, up to a limit, since a closed connection would lose the answer.
pub fn refuse(stream: &mut TcpStream, (status, sentence): Refusal) {
    let sent = answer(stream, status, "text/plain", &format!("{sentence}\n"));
    if sent.and_then(|()| stream.shutdown(Shutdown::Write)).is_ok() {
        let deadline = Instant::now() + LINGER;
        let mut rest = Vec::new();
        while rest.len() < MOST_LINGERED
            && read_some(stream, &mut rest, MOST_LINGERED, deadline).is_ok()
        {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn request(lines: &[&str]) -> Option<Request> {
        Request::parse(format!("{}\r\n\r\n", lines.join("\r\n")).as_bytes())
    }

    #[test]
    fn what_is_no_request_is_not_taken_for_one() {
        for lines in [
            &["GET /"][..],
            &["GET  / HTTP/1.1"],
            &["GET / HTTP/2"],
            &["GET http://localhost/ HTTP/1.1"],
            &["GET / HTTP/1.1", "no colon"],
            &["GET / HTTP/1.1", "a b: c"],
            &["GET / HTTP/1.1", "Host: localhost", " evil.example"],
            &[""],
        ] {
            assert!(request(lines).is_none(), "{lines:?}");
        }
        assert_eq!(
            request(&["GET /events?again=1 HTTP/1.1"]).unwrap().name,
            "events"
        );
    }

    #[test]
    fn only_names_of_this_machine_are_answered_and_the_name_of_its_proxy_with_the_token() {
        let known = |path: &str, hosts: &[&str], [host, token]: [&str; 2]| {
            let hosts = hosts.iter().map(|host| format!("Host: {host}"));
            let lines: Vec<String> = std::iter::once(format!("GET {path} HTTP/1.1"))
                .chain(hosts)
                .collect();
            request(&lines.iter().map(String::as_str).collect::<Vec<_>>())
                .unwrap()
                .expect_known(host, token)
                .is_ok()
        };
        for (path, host, expected) in [
            ("/?access=5", "hub.example", true),
            (
                "/user/me/proxy/7/events?access=5&a=b",
                "HUB.example:8000",
                true,
            ),
            ("/?access=5", "localhost:7070", true),
            ("/", "localhost:7070", false),
            ("/?access=", "hub.example", false),
            ("/?access=6", "hub.example", false),
            ("/?xaccess=5", "hub.example", false),
            ("/access=5", "hub.example", false),
            ("/?access=5", "evil.example", false),
            ("/?access=5", "hub.example.evil.example", false),
        ] {
            let proxy = ["hub.example", "?access=5"];
            assert_eq!(known(path, &[host], proxy), expected, "{path} {host}");
        }
        let allowed = |hosts: &[&str]| known("/", hosts, ["localhost", ""]);
        for host in [
            "localhost",
            "LocalHost:80",
            "127.0.0.1:7070",
            "[::1]:7070",
            "[::1]",
        ] {
            assert!(allowed(&[host]), "{host}");
        }
        for host in [
            "evil.example",
            "localhost.evil.example",
            "evil.example:localhost",
            "127.0.0.1.evil.example",
            "",
        ] {
            assert!(!allowed(&[host]), "{host}");
        }
        assert!(
            !allowed(&[])
                && !allowed(&["localhost", "evil.example"])
                && !allowed(&["localhost", "localhost"])
        );
    }

    #[test]
    fn no_page_of_another_site_may_read() {
        let allowed = |path: &str, lines: &[&str]| {
            let line = format!("GET {path} HTTP/1.1");
            let all = [&[&*line, "Host: localhost:1"], lines].concat();
            request(&all).unwrap().expect_own(false).is_ok()
        };
        for path in ["/events", "/user/me/proxy/1/events"] {
            for lines in [
                &[][..],
                &["Origin: http://localhost:1"],
                &["Origin: https://localhost:1"],
                &["Sec-Fetch-Site: same-origin"],
                &["Sec-Fetch-Site: none", "Sec-Fetch-Dest: document"],
            ] {
                assert!(allowed(path, lines), "{path} {lines:?}");
            }
            for lines in [
                &["Origin: http://evil.example"][..],
                &["Origin: http://localhost:1", "Origin: http://evil.example"],
                &["Sec-Fetch-Site: none", "Sec-Fetch-Site: cross-site"],
                &["Origin: null"],
                &["Origin: http://localhost:2"],
                &["Sec-Fetch-Site: cross-site", "Sec-Fetch-Dest: empty"],
                &["Sec-Fetch-Site: same-site", "Sec-Fetch-Dest: image"],
                &["Sec-Fetch-Site: cross-site", "Sec-Fetch-Dest: iframe"],
                &["Sec-Fetch-Site: cross-site", "Sec-Fetch-Dest: document"],
            ] {
                assert!(!allowed(path, lines), "{path} {lines:?}");
            }
        }
    }

    #[test]
    fn only_the_page_itself_may_send_something() {
        let allowed = |lines: &[&str]| {
            let all = [&["POST /controls HTTP/1.1", "Host: localhost:1"], lines].concat();
            request(&all).unwrap().expect_own(false).is_ok()
        };
        let json = "Content-Type: application/json";
        assert!(allowed(&[json, "Origin: http://localhost:1"]));
        assert!(allowed(&[
            json,
            "Origin: https://hub.example",
            "Sec-Fetch-Site: same-origin"
        ]));
        for lines in [
            &[json][..],
            &["Content-Type: text/plain", "Origin: http://localhost:1"],
            &["Origin: http://localhost:1"],
            &[json, "Origin: http://localhost:2"],
            &[json, "Origin: http://evil.example"],
            &[
                json,
                "Origin: http://localhost:1",
                "Sec-Fetch-Site: cross-site",
            ],
            &[
                json,
                "Origin: http://localhost:1",
                "Sec-Fetch-Site: same-site",
            ],
            &[json, "Origin: null"],
        ] {
            assert!(!allowed(lines), "{lines:?}");
        }
    }
}
