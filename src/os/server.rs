//! A page on this machine, and a stream of events that it reads: a thread for each connection, and a bound on everything.

use std::collections::VecDeque;
use std::io::Write;
use std::net::{Ipv4Addr, TcpListener, TcpStream};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, anyhow};

use super::http::{PATIENCE, Refusal, Request, answer, head, refuse};
use super::threads::locked;

/// The most readers of events, and the most connections, including connections that only fetch the page.
const MOST_READERS: usize = 8;
const MOST_CONNECTIONS: usize = 32;

/// The events that are kept for readers that are a little late.
const KEPT: usize = 64;

/// The time without an event after which a reader gets an event without news.
const QUIET: Duration = Duration::from_secs(1);

const CROWDED: &str = "503 Service Unavailable";

/// What happens with the body of a POST to `controls`. An error is a sentence about it.
pub type OnPost = Box<dyn Fn(&[u8]) -> Result<(), &'static str> + Send + Sync>;

/// The port of a page (0: any free one), and the host name by which a proxy asks for it.
pub type Place<'a> = (u16, Option<&'a str>);

/// A page that is served as long as the program runs.
pub struct Server {
    /// Its port.
    pub port: u16,
    /// The host name by which a proxy asks.
    host: String,
    /// What each request must have in its address: a query with a secret, or nothing.
    pub token: String,
    page: Mutex<String>,
    on_post: OnPost,
    news: Mutex<News>,
    /// The permits of readers and of connections: each has a copy as long as it lives.
    readers: Arc<()>,
    connections: Arc<()>,
    /// Something was sent, or somebody reads.
    changed: Condvar,
}

#[derive(Default)]
struct News {
    /// The event that each reader gets first, and again where it has missed some.
    hello: String,
    /// The number of the first event that is kept.
    first: u64,
    events: VecDeque<String>,
}

impl News {
    /// The number of the next event.
    fn next(&self) -> u64 {
        self.first + self.events.len() as u64
    }
}

impl Server {
    /// Serves a page on this port of 127.0.0.1, whose readers get the event `hello` first. A proxy may run on another machine: for it,
    /// the page is served on all addresses, and each request must have a token.
    ///
    /// # Errors
    /// Fails if the port cannot be opened, or if the system refuses a thread.
    pub fn open(
        (port, host): Place,
        page: String,
        hello: &str,
        on_post: OnPost,
    ) -> Result<Arc<Self>> {
        let address = host.map_or(Ipv4Addr::LOCALHOST, |_| Ipv4Addr::UNSPECIFIED);
        let cannot = |error| {
            anyhow!(
                "cannot use port {port} of {address}: {error}; choose another one, or 0 for any free port"
            )
        };
        let listener = TcpListener::bind((address, port)).map_err(cannot)?;
        let port = listener.local_addr().map_err(cannot)?.port();
        let news = Mutex::new(News {
            hello: hello.into(),
            ..News::default()
        });
        let [readers, connections] = Default::default();
        let server = Arc::new(Self {
            port,
            host: host.unwrap_or("localhost").into(),
            token: host.map_or_else(String::new, |_| {
                format!("?access={:032x}", rand::random::<u128>())
            }),
            page: page.into(),
            on_post,
            news,
            readers,
            connections,
            changed: Condvar::new(),
        });
        let own = server.clone();
        thread::Builder::new()
            .spawn(move || own.accept(&listener))
            .context("cannot start a thread for the server")?;
        Ok(server)
    }

    /// Serves another page from now on.
    pub fn replace_page(&self, page: String) {
        *locked(&self.page) = page;
    }

    /// Sets the event that readers get first.
    pub fn greet(&self, hello: &str) {
        locked(&self.news).hello = hello.into();
    }

    /// Sends events, each as the protocol writes it, to all readers. Readers that are too late miss them.
    pub fn send(&self, events: &str) {
        let mut news = locked(&self.news);
        news.events.push_back(events.into());
        if news.events.len() > KEPT {
            news.events.pop_front();
            news.first += 1;
        }
        self.changed.notify_all();
    }

    /// Waits until somebody reads the events, and returns whether it had to.
    pub fn wait_for_reader(&self) -> bool {
        let is_alone = || Arc::strong_count(&self.readers) == 1;
        let news = locked(&self.news);
        let waits = is_alone();
        drop(self.changed.wait_while(news, |_| is_alone()));
        waits
    }

    fn accept(self: Arc<Self>, listener: &TcpListener) {
        for stream in listener.incoming() {
            // A failure may mean that there are no descriptors left for a while.
            let Ok(mut stream) = stream else {
                thread::sleep(Duration::from_millis(50));
                continue;
            };
            let _ = stream.set_write_timeout(Some(PATIENCE));
            let Some(permit) = self.take_permit(&self.connections, MOST_CONNECTIONS) else {
                let _ = answer(
                    &mut stream,
                    CROWDED,
                    "text/plain",
                    "There are too many connections.\n",
                );
                continue;
            };
            let server = self.clone();
            // Without a thread, the connection is closed.
            let _ = thread::Builder::new().spawn(move || {
                let _permit = permit;
                server.serve(stream);
            });
        }
    }

    /// A permit, to be kept as long as it is used, unless there are `most` of them already.
    fn take_permit(&self, permits: &Arc<()>, most: usize) -> Option<Arc<()>> {
        // Nobody else counts meanwhile.
        let _news = locked(&self.news);
        let permit = (Arc::strong_count(permits) <= most).then(|| permits.clone());
        self.changed.notify_all();
        permit
    }

    fn serve(&self, mut stream: TcpStream) {
        let _ = stream.set_nodelay(true);
        let answered =
            Request::read(&mut stream).and_then(|request| self.answer(&mut stream, &request));
        if let Err(refusal) = answered {
            refuse(&mut stream, refusal);
        }
    }

    fn answer(&self, stream: &mut TcpStream, request: &Request) -> Result<(), Refusal> {
        request.expect_known(&self.host, &self.token)?;
        let not_here = "This method is not allowed here.";
        // An error of a write is a reader that has gone, or has read nothing for too long.
        let _ = match (&*request.method, &*request.name) {
            ("GET", "") => {
                let page = locked(&self.page).clone();
                answer(stream, "200 OK", "text/html", &page)
            }
            ("GET", "events") => {
                request.expect_own(!self.token.is_empty())?;
                let permit = self.take_permit(&self.readers, MOST_READERS);
                let _permit = permit.ok_or((CROWDED, "There are too many viewers."))?;
                self.send_events(stream)
            }
            ("POST", "controls") => {
                request.expect_own(!self.token.is_empty())?;
                (self.on_post)(&request.body).map_err(|sentence| ("400 Bad Request", sentence))?;
                stream.write_all(head("204 No Content", &[]).as_bytes())
            }
            (_, "" | "events") => {
                return Err(("405 Method Not Allowed\r\nAllow: GET", not_here));
            }
            (_, "controls") => {
                return Err(("405 Method Not Allowed\r\nAllow: POST", not_here));
            }
            _ => return Err(("404 Not Found", "There is no such page.")),
        };
        Ok(())
    }

    fn send_events(&self, stream: &mut TcpStream) -> std::io::Result<()> {
        let more = ["Content-Type: text/event-stream", "X-Accel-Buffering: no"];
        let (mut text, mut next) = {
            let news = locked(&self.news);
            (head("200 OK", &more) + &news.hello, news.next())
        };
        // A proxy must ask again: it may go on reading when its reader has gone.
        let end = Instant::now() + Duration::from_secs(60);
        while self.token.is_empty() || Instant::now() < end {
            stream.write_all(text.as_bytes())?;
            let waited = self
                .changed
                .wait_timeout_while(locked(&self.news), QUIET, |news| news.next() == next);
            let (news, _) = waited.unwrap_or_else(PoisonError::into_inner);
            text = match next.checked_sub(news.first) {
                Some(old) if old < news.events.len() as u64 => {
                    news.events.range(old as usize..).cloned().collect()
                }
                Some(_) => "event: beat\ndata: 1\n\n".to_owned(),
                None => news.hello.clone(),
            };
            next = news.next();
        }
        Ok(())
    }
}
