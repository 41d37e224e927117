//! The HTTP routes and their access rules.
//!
//! | route | content |
//! |---|---|
//! | POST /control | a [`Command`](super::Command); replies with an [`Answer`](super::Answer): 200 accepted, 409 refused, 4xx malformed |
//! | GET /status | the full state as JSON |
//! | GET /metrics | counters and quantiles as Prometheus text |
//! | GET /healthz | 200, or 503 with the reason; needs no token |
//! | GET /, /page/... | the operator's page; needs no token |
//! | GET /page/socket | its WebSocket, see [`super::socket`]; the token is the subprotocol `token.` followed by its bytes in hexadecimal |
//!
//! Three rules protect against pages of other sites in the operator's browser. Commands must be `application/json`, which a form cannot send. An
//! `Origin` must be the server's own and occur once. Without a token the `Host` must be an IP address or localhost, which prevents DNS rebinding.

use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::Json;
use axum::Router;
use axum::extract::connect_info::ConnectInfo;
use axum::extract::rejection::JsonRejection;
use axum::extract::{DefaultBodyLimit, Request, State};
use axum::http::{HeaderMap, StatusCode, header};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use serde_json::Value;
use tracing::warn;

use super::attempts::Attempts;
use super::{ControlPort, Shared, assets, refusal, socket, words};
use echotank_core::settings::Requester;

/// Longest command, bytes.
const MAX_BODY_BYTES: usize = 64 * 1024;
/// Time limit for receiving and answering a request; commands do not wait.
const REQUEST_TIMEOUT: Duration = Duration::from_secs(10);

type Port = State<Arc<dyn ControlPort>>;

pub(super) fn router(shared: Shared, token: Option<String>) -> Router {
    let guarded = Router::new()
        .route("/control", post(control))
        .route("/status", get(status))
        .route("/metrics", get(metrics))
        .route("/page/socket", get(socket::open))
        .layer(middleware::from_fn_with_state(
            Arc::new(Access::new(token)),
            guard,
        ));
    Router::new()
        .route("/healthz", get(health))
        .merge(assets::routes())
        .merge(guarded)
        .layer(DefaultBodyLimit::max(MAX_BODY_BYTES))
        .layer(middleware::from_fn(limit_time))
        .with_state(shared)
}

async fn control(
    State(port): Port,
    ConnectInfo(peer): ConnectInfo<SocketAddr>,
    body: Result<Json<Value>, JsonRejection>,
) -> impl IntoResponse {
    let command = match body {
        Ok(Json(value)) => words::parse(&value),
        Err(JsonRejection::JsonSyntaxError(_)) => {
            return refusal(StatusCode::BAD_REQUEST, "the command is not valid JSON");
        }
        Err(rejection) => return refusal(rejection.status(), &rejection.body_text()),
    };
    let command = match command {
        Ok(command) => command,
        Err(why) => return refusal(StatusCode::UNPROCESSABLE_ENTITY, &why),
    };
    let by = Requester {
        via: "control",
        peer: Some(peer),
    };
    let answer = port.command(&command, by);
    let status = match answer.accepted {
        true => StatusCode::OK,
        false => StatusCode::CONFLICT,
    };
    (status, Json(answer)).into_response()
}

async fn status(State(port): Port) -> impl IntoResponse {
    Json(port.status())
}

async fn metrics(State(port): Port) -> impl IntoResponse {
    let kind = "text/plain; version=0.0.4; charset=utf-8";
    ([(header::CONTENT_TYPE, kind)], port.metrics())
}

async fn health(State(port): Port) -> impl IntoResponse {
    match port.health_problem() {
        None => (StatusCode::OK, "ok\n".to_owned()),
        Some(why) => (StatusCode::SERVICE_UNAVAILABLE, format!("{why}\n")),
    }
}

/// Answers a request whose body does not arrive in time.
async fn limit_time(request: Request, next: Next) -> Response {
    let response = tokio::time::timeout(REQUEST_TIMEOUT, next.run(request)).await;
    response.unwrap_or_else(|_| {
        refusal(
            StatusCode::REQUEST_TIMEOUT,
            "the request did not arrive in time",
        )
    })
}

/// Access rules of the routes that need a token.
struct Access {
    token: Option<String>,
    attempts: Attempts,
}

impl Access {
    fn new(token: Option<String>) -> Self {
        Self {
            token,
            attempts: Attempts::default(),
        }
    }
}

async fn guard(
    State(access): State<Arc<Access>>,
    ConnectInfo(peer): ConnectInfo<SocketAddr>,
    request: Request,
    next: Next,
) -> Response {
    let (headers, now) = (request.headers(), Instant::now());
    let gives_token = access.token.is_some() && !given_tokens(headers).is_empty();
    if gives_token && access.attempts.are_exhausted(peer.ip(), now) {
        return refusal(
            StatusCode::TOO_MANY_REQUESTS,
            "too many wrong tokens from this address: wait some seconds",
        );
    }
    match objection(headers, access.token.as_deref()) {
        None => next.run(request).await,
        Some((status, why)) => {
            let path = request.uri().path();
            warn!(client = %peer, path, why, "request refused");
            let is_wrong = gives_token && status == StatusCode::UNAUTHORIZED;
            if is_wrong && access.attempts.note(peer.ip(), now) {
                warn!(client = %peer, "too many wrong tokens: further ones are refused unread and not logged");
            }
            refusal(status, why)
        }
    }
}

/// The tokens of a request, as text and in hexadecimal.
fn given_tokens(headers: &HeaderMap) -> Vec<GivenToken<'_>> {
    let text = |name| headers.get(name).and_then(|value| value.to_str().ok());
    let plain = text(header::AUTHORIZATION).and_then(|v| v.strip_prefix("Bearer "));
    // A browser cannot add a header to a WebSocket request.
    let protocols = text(header::SEC_WEBSOCKET_PROTOCOL).unwrap_or_default();
    let in_hex = protocols
        .split(',')
        .find_map(|protocol| protocol.trim().strip_prefix("token."));
    let given = plain.map(GivenToken::Plain);
    given
        .into_iter()
        .chain(in_hex.map(GivenToken::Hex))
        .collect()
}

enum GivenToken<'a> {
    Plain(&'a str),
    Hex(&'a str),
}

impl GivenToken<'_> {
    fn is(&self, token: &str) -> bool {
        match self {
            Self::Plain(given) => same(given.as_bytes(), token.as_bytes()),
            Self::Hex(given) => same(given.as_bytes(), hex(token).as_bytes()),
        }
    }
}

/// Reason to refuse a request, if any.
fn objection(headers: &HeaderMap, token: Option<&str>) -> Option<(StatusCode, &'static str)> {
    let text = |name| headers.get(name).and_then(|value| value.to_str().ok());
    // Programs differ in which of two values they use.
    for name in [header::HOST, header::ORIGIN, header::AUTHORIZATION] {
        if headers.get_all(name).iter().count() > 1 {
            return Some((
                StatusCode::BAD_REQUEST,
                "Host, Origin and Authorization may be given only once",
            ));
        }
    }
    let host = text(header::HOST).unwrap_or_default();
    let own_origin = |origin: &str| {
        let site = origin.strip_prefix("http://");
        site.or(origin.strip_prefix("https://")) == Some(host)
    };
    if headers.contains_key(header::ORIGIN) && !text(header::ORIGIN).is_some_and(own_origin) {
        return Some((
            StatusCode::FORBIDDEN,
            "the request comes from a page of another site",
        ));
    }
    match token {
        Some(token) => {
            let known = given_tokens(headers).iter().any(|given| given.is(token));
            (!known).then_some((
                StatusCode::UNAUTHORIZED,
                "a token is required: Authorization: Bearer TOKEN",
            ))
        }
        None => (!is_local_name(host)).then_some((
            StatusCode::FORBIDDEN,
            "Host: must be an IP address or localhost without a token",
        )),
    }
}

fn hex(token: &str) -> String {
    token.bytes().map(|byte| format!("{byte:02x}")).collect()
}

/// Compares two byte strings in a time that does not depend on their content.
fn same(a: &[u8], b: &[u8]) -> bool {
    let differing = a.iter().zip(b).fold(0, |sum, (a, b)| sum | (a ^ b));
    a.len() == b.len() && differing == 0
}

/// Whether a host is an IP address or localhost: `127.0.0.1:7780`, `[::1]:7780`, `localhost`.
fn is_local_name(host: &str) -> bool {
    let name = match host.rsplit_once(':') {
        Some((name, port)) if !name.is_empty() && port.bytes().all(|b| b.is_ascii_digit()) => name,
        _ => host,
    };
    let address = name.trim_start_matches('[').trim_end_matches(']');
    name == "localhost" || address.parse::<IpAddr>().is_ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn asked(pairs: &[(&'static str, &str)], token: Option<&str>) -> Option<u16> {
        let mut headers = HeaderMap::new();
        for (name, value) in pairs {
            headers.append(*name, value.parse().expect("a header"));
        }
        objection(&headers, token).map(|(status, _)| status.as_u16())
    }

    #[test]
    fn pages_of_other_sites_and_names_that_point_here_are_kept_out() {
        for (pairs, want) in [
            (vec![("host", "127.0.0.1:7780")], None),
            (vec![("host", "localhost:7780")], None),
            (vec![("host", "[::1]:7780")], None),
            (vec![("host", "evil.example:7780")], Some(403)),
            (vec![], Some(403)),
            (
                vec![
                    ("host", "127.0.0.1:7780"),
                    ("origin", "http://127.0.0.1:7780"),
                ],
                None,
            ),
            (
                vec![
                    ("host", "127.0.0.1:7780"),
                    ("origin", "http://evil.example"),
                ],
                Some(403),
            ),
            (
                vec![("host", "127.0.0.1:7780"), ("origin", "null")],
                Some(403),
            ),
            (
                vec![
                    ("host", "127.0.0.1:7780"),
                    ("origin", "http://127.0.0.1:7780"),
                    ("origin", "http://evil.example"),
                ],
                Some(400),
            ),
            (
                vec![("host", "127.0.0.1:7780"), ("host", "evil.example")],
                Some(400),
            ),
        ] {
            assert_eq!(asked(&pairs, None), want, "{pairs:?}");
        }
    }

    #[test]
    fn a_token_is_asked_for_whole() {
        let host = ("host", "rig.example");
        assert_eq!(asked(&[host], Some("secret")), Some(401));
        for (given, want) in [
            ("Bearer secret", None),
            ("Bearer secre", Some(401)),
            ("Bearer secrets", Some(401)),
            ("secret", Some(401)),
            ("Bearer ", Some(401)),
        ] {
            let got = asked(&[host, ("authorization", given)], Some("secret"));
            assert_eq!(got, want, "{given}");
        }
    }
}
