//! The HTTP routes and their access rules.
//!
//! | route | content |
//! |---|---|
//! | POST /control | a [`Command`]; replies with an [`Answer`](super::Answer): 200 accepted, 409 refused, 4xx malformed |
//! | GET /status | the full state as JSON |
//! | GET /metrics | counters and quantiles as Prometheus text |
//! | GET /healthz | 200, or 503 with the reason; needs no token |
//! | GET /, /page/... | the operator's page; needs no token |
//! | GET /page/socket | its WebSocket, see [`super::socket`]; the token is the subprotocol `token.` followed by its bytes in hexadecimal |
//!
//! Against pages of other sites in the operator's browser: commands must be `application/json`, which a form cannot send. An `Origin` must be the
//! server's own. Without a token the `Host` must be an IP address or localhost, which defeats DNS rebinding.

use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;

use axum::Json;
use axum::Router;
use axum::extract::connect_info::ConnectInfo;
use axum::extract::rejection::JsonRejection;
use axum::extract::{DefaultBodyLimit, Request, State};
use axum::http::{HeaderMap, StatusCode, header};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use tracing::warn;

use super::{Command, ControlPort, Shared, assets, refusal, socket};
use echotank_core::settings::Asker;

/// Longest command, bytes.
const MAX_BODY_BYTES: usize = 64 * 1024;

type Port = State<Arc<dyn ControlPort>>;

pub(super) fn router(shared: Shared, token: Option<String>) -> Router {
    let guarded = Router::new()
        .route("/control", post(control))
        .route("/status", get(status))
        .route("/metrics", get(metrics))
        .route("/page/socket", get(socket::open))
        .layer(middleware::from_fn_with_state(Arc::new(token), guard));
    Router::new()
        .route("/healthz", get(health))
        .merge(assets::routes())
        .merge(guarded)
        .layer(DefaultBodyLimit::max(MAX_BODY_BYTES))
        .with_state(shared)
}

async fn control(
    State(port): Port,
    ConnectInfo(peer): ConnectInfo<SocketAddr>,
    command: Result<Json<Command>, JsonRejection>,
) -> impl IntoResponse {
    let command = match command {
        Ok(Json(command)) => command,
        Err(rejection) => return refusal(rejection.status(), &rejection.body_text()),
    };
    let by = Asker {
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

async fn guard(State(token): State<Arc<Option<String>>>, request: Request, next: Next) -> Response {
    match objection(request.headers(), token.as_deref()) {
        None => next.run(request).await,
        Some((status, why)) => {
            let peer = request.extensions().get::<ConnectInfo<SocketAddr>>();
            let client = peer.map(|ConnectInfo(peer)| peer.to_string());
            warn!(client, path = request.uri().path(), why, "request refused");
            refusal(status, why)
        }
    }
}

/// Reason to refuse a request.
fn objection(headers: &HeaderMap, token: Option<&str>) -> Option<(StatusCode, &'static str)> {
    let text = |name| headers.get(name).and_then(|value| value.to_str().ok());
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
            let given = text(header::AUTHORIZATION).and_then(|v| v.strip_prefix("Bearer "));
            // A browser cannot add a header to a WebSocket request.
            let protocols = text(header::SEC_WEBSOCKET_PROTOCOL).unwrap_or_default();
            let in_hex = protocols
                .split(',')
                .find_map(|protocol| protocol.trim().strip_prefix("token."));
            let known = given.is_some_and(|given| same(given.as_bytes(), token.as_bytes()))
                || in_hex.is_some_and(|given| same(given.as_bytes(), hex(token).as_bytes()));
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

/// Compares in a time that does not depend on the content.
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
            headers.insert(*name, value.parse().expect("a header"));
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
