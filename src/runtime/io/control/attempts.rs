//! Limits how often a client may give a wrong token.

use std::collections::HashMap;
use std::net::IpAddr;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Number of wrong tokens that a client may send in a burst.
const MAX_WRONG: f64 = 10.0;
/// Time after which one more wrong token is allowed.
const FORGIVEN_AFTER: Duration = Duration::from_secs(6);
/// Maximum number of clients remembered.
const MAX_CLIENTS: usize = 1024;

/// Wrong tokens of each client address.
#[derive(Default)]
pub(super) struct Attempts(Mutex<HashMap<IpAddr, FailedAttempts>>);

#[derive(Clone, Copy)]
struct FailedAttempts {
    /// Wrong tokens not yet forgiven at `at`.
    count: f64,
    at: Instant,
}

impl FailedAttempts {
    fn count(&self, now: Instant) -> f64 {
        let forgiven = now.duration_since(self.at).as_secs_f64() / FORGIVEN_AFTER.as_secs_f64();
        (self.count - forgiven).max(0.0)
    }
}

impl Attempts {
    /// Whether the client has exceeded its limit of wrong tokens, so that none of its tokens is checked.
    pub(super) fn are_exhausted(&self, client: IpAddr, now: Instant) -> bool {
        let all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let wrong = all.get(&client.to_canonical());
        wrong.is_some_and(|wrong| wrong.count(now) > MAX_WRONG - 1.0)
    }

    /// Counts a wrong token. Returns true if this token exhausts the client's limit.
    pub(super) fn note(&self, client: IpAddr, now: Instant) -> bool {
        let mut all = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if all.len() >= MAX_CLIENTS {
            all.retain(|_, wrong| wrong.count(now) > 0.0);
        }
        if all.len() >= MAX_CLIENTS {
            let oldest = all.iter().min_by_key(|(_, wrong)| wrong.at);
            if let Some(oldest) = oldest.map(|(ip, _)| *ip) {
                all.remove(&oldest);
            }
        }
        let fresh = FailedAttempts {
            count: 0.0,
            at: now,
        };
        let wrong = all.entry(client.to_canonical()).or_insert(fresh);
        *wrong = FailedAttempts {
            count: wrong.count(now) + 1.0,
            at: now,
        };
        wrong.count > MAX_WRONG - 1.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_client_that_guesses_is_not_listened_to_for_some_time_and_others_are() {
        let (attempts, begin) = (Attempts::default(), Instant::now());
        let (guesser, other) = (IpAddr::from([192, 0, 2, 1]), IpAddr::from([192, 0, 2, 2]));
        for k in 1..=10 {
            assert!(!attempts.are_exhausted(guesser, begin), "{k}");
            assert_eq!(attempts.note(guesser, begin), k == 10);
        }
        assert!(attempts.are_exhausted(guesser, begin));
        assert!(!attempts.are_exhausted(other, begin));
        let later = begin + FORGIVEN_AFTER;
        assert!(!attempts.are_exhausted(guesser, later));
        assert!(attempts.note(guesser, later));
    }

    #[test]
    fn many_clients_take_a_bounded_memory() {
        let (attempts, now) = (Attempts::default(), Instant::now());
        for k in 0..5000_u32 {
            attempts.note(IpAddr::from(k.to_be_bytes()), now);
        }
        assert_eq!(attempts.0.lock().expect("whole").len(), MAX_CLIENTS);
    }
}
