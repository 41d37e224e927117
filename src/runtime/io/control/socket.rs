//! The page's WebSocket, `/page/socket`.
//!
//! | sent | content |
//! |---|---|
//! | text `{"hello": ..}` | once: the rig |
//! | text `{"state": ..}` | state that belongs to no ping; twice a second and after each change |
//! | text `{"world": ..}` | the targets, on request |
//! | text `{"answer": .., "id": ..}` | reply to a command |
//! | text `{"dropped": n}` | number of frames that this page missed |
//! | text `{"error": ..}` | a message was malformed |
//! | binary | see [`super::frame`] |
//!
//! | received, text | content |
//! |---|---|
//! | `{"look": ..}` | a [`Want`]: the sonar and its views |
//! | `{"command": {"id": 1, "command": ..}}` | a [`Command`], as for POST /control |
//! | `{"relief": ..}` | a [`ReliefTile`] of the seabed |
//! | `{"world": {}}` | the targets |
//!
//! Every page has its own task on the control thread. A page that does not read does not delay the others.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use axum::extract::State;
use axum::extract::connect_info::ConnectInfo;
use axum::extract::ws::{CloseFrame, Message, Utf8Bytes, WebSocket, WebSocketUpgrade, close_code};
use axum::http::StatusCode;
use axum::response::Response;
use serde::Deserialize;
use serde_json::{Value, json};
use tokio::sync::{Mutex, Semaphore, watch};
use tokio::time::{Instant, MissedTickBehavior, interval, sleep, timeout};

use super::feed::{Next, Page, Want};
use super::{Command, ControlPort, Shared, refusal};
use echotank_core::settings::Requester;

/// Maximum number of open pages.
pub(crate) const MAX_PAGES: usize = 64;
/// Longest message from a page, bytes.
const MAX_MESSAGE_BYTES: usize = 16 * 1024;
/// Time limit for sending one message. A page that exceeds the limit is closed.
const SEND_TIMEOUT: Duration = Duration::from_secs(30);
/// Interval of WebSocket pings; a page silent for [`SILENCE_TIMEOUT`] is closed.
const KEEP_ALIVE: Duration = Duration::from_secs(15);
const SILENCE_TIMEOUT: Duration = Duration::from_secs(60);
/// Interval between checks for changes of the state, and longest interval between states.
const STATE_INTERVAL: Duration = Duration::from_millis(100);
const STATE_EVERY: Duration = Duration::from_millis(500);
/// Pause after each seabed tile, shared by all pages. The pause limits the processor time.
const RELIEF_REST: Duration = Duration::from_millis(8);

/// A square tile of the seabed: 128 cells of 2^level m along each side, plus a border of one cell.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReliefTile {
    /// Cells are 2^level m wide.
    pub level: u8,
    /// Northward index in tiles of this level from the origin of the world.
    pub row: i32,
    /// Eastward index in tiles of this level from the origin of the world.
    pub col: i32,
}

#[derive(Deserialize)]
#[serde(rename_all = "kebab-case", deny_unknown_fields)]
enum PageMessage {
    Look(Want),
    Command { id: u64, command: Box<Command> },
    Relief(ReliefTile),
    World {},
}

/// State shared by all pages.
pub(super) struct Pages {
    slots: Arc<Semaphore>,
    state: watch::Sender<Utf8Bytes>,
    relief_turn: Mutex<()>,
}

impl Pages {
    pub(super) fn new() -> Self {
        Self {
            slots: Arc::new(Semaphore::new(MAX_PAGES)),
            state: watch::Sender::new(Utf8Bytes::default()),
            relief_turn: Mutex::new(()),
        }
    }

    /// Returns when no page is open.
    pub(super) async fn closed(&self) {
        let _ = self.slots.acquire_many(MAX_PAGES as u32).await;
    }

    /// Renews the state while pages are open. Never returns.
    pub(super) async fn renew(&self, port: &dyn ControlPort) {
        let mut ticks = interval(STATE_INTERVAL);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut written = (0, Instant::now());
        loop {
            ticks.tick().await;
            if self.state.receiver_count() == 0 {
                continue;
            }
            let revision = port.revision();
            if revision != written.0 || written.1.elapsed() >= STATE_EVERY {
                written = (revision, Instant::now());
                let state = json!({ "state": port.page_state() });
                self.state.send_replace(state.to_string().into());
            }
        }
    }
}

pub(super) async fn open(
    State(shared): State<Shared>,
    ConnectInfo(peer): ConnectInfo<SocketAddr>,
    upgrade: WebSocketUpgrade,
) -> Response {
    let Ok(slot) = Arc::clone(&shared.pages.slots).try_acquire_owned() else {
        let why = format!("{MAX_PAGES} pages are open already");
        tracing::warn!(client = %peer, "{why}");
        return refusal(StatusCode::SERVICE_UNAVAILABLE, &why);
    };
    upgrade
        .protocols(["echotank"])
        .max_message_size(MAX_MESSAGE_BYTES)
        .max_frame_size(MAX_MESSAGE_BYTES)
        .on_upgrade(move |socket| async move {
            let _slot = slot;
            tracing::info!(client = %peer, "page opened");
            serve(socket, shared, peer).await;
            tracing::info!(client = %peer, "page closed");
        })
}

/// Marks a page that has disconnected or must be closed.
struct Disconnected;

struct Session {
    socket: WebSocket,
    shared: Shared,
    by: Requester,
    page: Page,
}

async fn serve(socket: WebSocket, shared: Shared, peer: SocketAddr) {
    let mut stopped = shared.stopped.clone();
    let mut session = Session {
        page: shared.port.feed().join(),
        socket,
        shared,
        by: Requester {
            via: "page",
            peer: Some(peer),
        },
    };
    tokio::select! {
        _ = session.run() => {}
        _ = stopped.wait_for(|&stop| stop) => {}
    }
    // The page then tries to reconnect until a daemon runs again.
    let goodbye = CloseFrame {
        code: close_code::AWAY,
        reason: "the daemon stops".into(),
    };
    let _ = timeout(
        STATE_INTERVAL,
        session.socket.send(Message::Close(Some(goodbye))),
    )
    .await;
}

impl Session {
    async fn run(&mut self) -> Result<(), Disconnected> {
        let hello = json!({ "hello": self.shared.port.hello() });
        self.say(hello).await?;
        let mut state = self.shared.pages.state.subscribe();
        state.mark_changed();
        let mut alive = interval(KEEP_ALIVE);
        let mut last_received = Instant::now();
        loop {
            tokio::select! {
                message = self.socket.recv() => {
                    // An oversized or malformed frame ends the session.
                    let message = message.ok_or(Disconnected)?.map_err(|_| Disconnected)?;
                    last_received = Instant::now();
                    self.take(message).await?;
                }
                next = self.page.next() => match next {
                    Next::Frame(frame) => {
                        self.send(Message::Binary(frame.bytes.clone())).await?;
                        self.page.sent();
                    }
                    Next::Dropped(n) => self.say(json!({ "dropped": n })).await?,
                    Next::End => return Err(Disconnected),
                },
                _ = state.changed() => {
                    let text = state.borrow_and_update().clone();
                    if !text.is_empty() {
                        self.send(Message::Text(text)).await?;
                    }
                }
                _ = alive.tick() => {
                    if last_received.elapsed() > SILENCE_TIMEOUT {
                        return Err(Disconnected);
                    }
                    self.send(Message::Ping(Default::default())).await?;
                }
            }
        }
    }

    async fn take(&mut self, message: Message) -> Result<(), Disconnected> {
        let text = match message {
            Message::Text(text) => text,
            Message::Ping(_) | Message::Pong(_) => return Ok(()),
            Message::Binary(_) => return self.complain("only text messages are accepted").await,
            Message::Close(_) => return Err(Disconnected),
        };
        match serde_json::from_str(&text) {
            Ok(PageMessage::Look(want)) => self.look(want).await,
            Ok(PageMessage::Command { id, command }) => {
                let answer = self.shared.port.command(&command, self.by);
                self.say(json!({ "answer": answer, "id": id })).await
            }
            Ok(PageMessage::Relief(tile)) => self.relief(tile).await,
            Ok(PageMessage::World {}) => {
                let world = json!({ "world": self.shared.port.world() });
                self.say(world).await
            }
            Err(why) => self.complain(&why.to_string()).await,
        }
    }

    async fn look(&mut self, want: Want) -> Result<(), Disconnected> {
        for frame in self.page.look(want) {
            self.send(Message::Binary(frame.bytes.clone())).await?;
            self.page.sent();
        }
        Ok(())
    }

    async fn relief(&mut self, tile: ReliefTile) -> Result<(), Disconnected> {
        let shared = self.shared.clone();
        let turn = shared.pages.relief_turn.lock().await;
        let bytes = shared.port.relief(tile);
        sleep(RELIEF_REST).await;
        drop(turn);
        match bytes {
            Some(bytes) => self.send(Message::Binary(bytes)).await,
            None => Ok(()),
        }
    }

    async fn complain(&mut self, why: &str) -> Result<(), Disconnected> {
        self.say(json!({ "error": why })).await
    }

    async fn say(&mut self, value: Value) -> Result<(), Disconnected> {
        self.send(Message::Text(value.to_string().into())).await
    }

    async fn send(&mut self, message: Message) -> Result<(), Disconnected> {
        let sent = timeout(SEND_TIMEOUT, self.socket.send(message)).await;
        sent.map_err(|_| Disconnected)?.map_err(|_| Disconnected)
    }
}
