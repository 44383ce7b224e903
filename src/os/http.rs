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
    /// Without the part from a question mark on.
    pub path: String,
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
        let path = target.split('?').next()?;
        let header = |line: &str| {
            let (name, value) = line.split_once(':')?;
            let is_name = !name.is_empty() && name.bytes().all(|c| c.is_ascii_graphic());
            is_name.then(|| (name.to_ascii_lowercase(), value.trim().to_owned()))
        };
        let headers = lines.map(header).collect::<Option<_>>()?;
        let fits = path.starts_with('/') && version.starts_with("HTTP/1.");
        fits.then(|| Self {
            method: method.into(),
            path: path.into(),
            headers,
            body: Vec::new(),
        })
    }

    /// The value of a header, unless it is there more than once.
    fn header(&self, name: &str) -> Option<&str> {
        let mut found = self.headers.iter().filter(|(own, _)| own == name);
        let (_, value) = found.next()?;
        found.next().is_none().then_some(value)
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

    /// Checks that the address in the browser belongs to this machine: another host name may have been made to lead here.
    ///
    /// # Errors
    /// Fails with the answer to send.
    pub fn expect_local(&self) -> Result<(), Refusal> {
        let host = self.header("host").unwrap_or_default();
        let name = match host.rsplit_once(':') {
            Some((name, port)) if port.bytes().all(|c| c.is_ascii_digit()) => name,
            _ => host,
        };
        let is_local = ["localhost", "127.0.0.1", "[::1]"]
            .iter()
            .any(|local| name.eq_ignore_ascii_case(local));
        let sentence = "Only requests to localhost, 127.0.0.1 and [::1] are answered: use one of these in the address.";
        is_local.then_some(()).ok_or(("403 Forbidden", sentence))
    }

    /// Checks that the request comes from the page, and not from a page of another origin in the same browser.
    ///
    /// # Errors
    /// Fails with the answer to send.
    pub fn expect_own(&self) -> Result<(), Refusal> {
        // This content type makes a browser ask before it sends the request from another origin. Such a question is not answered.
        let is_json = self
            .header("content-type")
            .is_some_and(|kind| kind.split(';').next() == Some("application/json"));
        let is_own = match (
            self.header("sec-fetch-site"),
            self.header("origin"),
            self.header("host"),
        ) {
            (Some(site), _, _) => site == "same-origin",
            (None, Some(origin), Some(host)) => origin.strip_prefix("http://") == Some(host),
            _ => false,
        };
        (is_json && is_own)
            .then_some(())
            .ok_or(("403 Forbidden", "Only the page itself may send this."))
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
            request(&["GET /events?again=1 HTTP/1.1"]).unwrap().path,
            "/events"
        );
    }

    #[test]
    fn only_names_of_this_machine_are_answered() {
        let allowed = |hosts: &[&str]| {
            let hosts = hosts.iter().map(|host| format!("Host: {host}"));
            let lines: Vec<String> = std::iter::once("GET / HTTP/1.1".to_owned())
                .chain(hosts)
                .collect();
            request(&lines.iter().map(String::as_str).collect::<Vec<_>>())
                .unwrap()
                .expect_local()
                .is_ok()
        };
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
    fn only_the_page_itself_may_send_something() {
        let allowed = |lines: &[&str]| {
            let all = [&["POST /controls HTTP/1.1", "Host: localhost:1"], lines].concat();
            request(&all).unwrap().expect_own().is_ok()
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
