//! The page's files, compiled into the binary, with headers that permit no other content.

use axum::Router;
use axum::http::{HeaderMap, HeaderName, HeaderValue, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;

/// Only content of this server: no inline code and no markup made from text.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' data:; base-uri 'none'; \
     form-action 'none'; frame-ancestors 'none'; require-trusted-types-for 'script'; trusted-types 'none'";

const HTML: &str = "text/html; charset=utf-8";
const CSS: &str = "text/css; charset=utf-8";
const SCRIPT: &str = "text/javascript; charset=utf-8";
const SVG: &str = "image/svg+xml";

macro_rules! asset {
    ($route:literal, $kind:expr, $file:literal) => {
        ($route, $kind, include_str!(concat!("page/", $file)))
    };
}

/// Route, content type and content.
const ASSETS: &[(&str, &str, &str)] = &[
    asset!("/", HTML, "index.html"),
    asset!("/page/style.css", CSS, "style.css"),
    asset!("/page/icon.svg", SVG, "icon.svg"),
    asset!("/page/app.js", SCRIPT, "app.js"),
    asset!("/page/link.js", SCRIPT, "link.js"),
    asset!("/page/lib.js", SCRIPT, "lib.js"),
    asset!("/page/waterfall.js", SCRIPT, "waterfall.js"),
    asset!("/page/fan.js", SCRIPT, "fan.js"),
    asset!("/page/scope.js", SCRIPT, "scope.js"),
    asset!("/page/elements.js", SCRIPT, "elements.js"),
    asset!("/page/track.js", SCRIPT, "track.js"),
    asset!("/page/motion.js", SCRIPT, "motion.js"),
    asset!("/page/health.js", SCRIPT, "health.js"),
    asset!("/page/bathymetry.js", SCRIPT, "bathymetry.js"),
    asset!("/page/controls.js", SCRIPT, "controls.js"),
    asset!("/page/faults.js", SCRIPT, "faults.js"),
    asset!("/page/profile.js", SCRIPT, "profile.js"),
    asset!("/page/save.js", SCRIPT, "save.js"),
    asset!("/page/verdict.js", SCRIPT, "verdict.js"),
];

pub(super) fn routes<S: Clone + Send + Sync + 'static>() -> Router<S> {
    ASSETS
        .iter()
        .fold(Router::new(), |router, &(route, kind, text)| {
            router.route(route, get(move || async move { asset(kind, text) }))
        })
}

fn asset(kind: &'static str, text: &'static str) -> Response {
    let mut headers = HeaderMap::new();
    let kept = [
        (header::CONTENT_TYPE, kind),
        // The next response may come from another version of the daemon.
        (header::CACHE_CONTROL, "no-cache"),
        (header::CONTENT_SECURITY_POLICY, POLICY),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::X_FRAME_OPTIONS, "DENY"),
        (header::REFERRER_POLICY, "no-referrer"),
        (
            HeaderName::from_static("cross-origin-opener-policy"),
            "same-origin",
        ),
        (
            HeaderName::from_static("cross-origin-resource-policy"),
            "same-origin",
        ),
    ];
    for (name, value) in kept {
        headers.insert(name, HeaderValue::from_static(value));
    }
    (headers, text).into_response()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_asks_for_nothing_that_is_not_in_the_binary() {
        let routes: Vec<_> = ASSETS.iter().map(|(route, ..)| *route).collect();
        for (route, _, text) in ASSETS {
            for scheme in ["http://", "https://", "//cdn", "ws://1", "wss://1"] {
                let text = text.replace("http://www.w3.org/2000/svg", "");
                assert!(!text.contains(scheme), "{route} has {scheme}");
            }
            for forbidden in [
                "innerHTML",
                "outerHTML",
                "insertAdjacentHTML",
                "document.write",
                "eval(",
                "new Function",
            ] {
                assert!(!text.contains(forbidden), "{route} has {forbidden}");
            }
            for import in text.split("from \"./").skip(1) {
                let name = import.split('"').next().unwrap_or_default();
                let wanted = format!("/page/{name}");
                assert!(routes.contains(&wanted.as_str()), "{route} imports {name}");
            }
        }
    }
}
