//! Wire formats against their published tables, files that third-party readers accept, and random bytes.

mod any_bytes;
mod bottom_records;
mod elements;
mod file;
mod fuzz;
mod golden;
mod jsf;
mod packets;
mod ping_protocol;
mod recordings;
mod stream;
mod support;
mod vita49;
mod wbms;
mod xtf;
