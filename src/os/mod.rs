//! The system around the program: files, the terminal, signals, locks, threads, pip, and a server for a page.

mod destination;
mod file;
mod folder;
mod http;
mod interrupt;
mod lock;
mod machine;
pub mod memory;
mod meshes;
mod output;
mod pip;
mod progress;
mod screen;
mod server;
mod similar;
mod stderr;
mod terminal;
mod threads;

pub use console::colors_enabled;
pub use destination::Destination;
pub use file::{
    Cannot, Stamp, expect_named, gzip, read_bytes, read_text, read_unpacked, same_file, shown,
    stamp,
};
pub use folder::Folder;
pub use interrupt::{Interrupted, Requests, exit_code, expect_no_stop};
pub use lock::{Hold, LOCK, Locked};
pub use machine::{Machine, processor_seconds, program_checksum};
pub use meshes::hand_meshes;
pub use output::{
    OutputFile, final_path, folder_of, is_abandoned, make_own, name_also, nicety, put_aside,
    remove_unfinished, sync, sync_folder, unused_name, write_whole,
};
pub use progress::{Bar, Status, StatusLine, count, of_all, progress_bar, span};
pub use screen::{Screen, aligned, text_of};
pub use server::{OnPost, Place, Server};
pub use similar::similar;
pub use stderr::{Queued, drain};
pub(crate) use terminal::say;
pub use terminal::{
    called_as, harmless, has_display, is_terminal, number, print, quoted, quoted_path, say_line,
    shortened, speak_as,
};
pub use threads::{locked, start_threads, thread_pool};
