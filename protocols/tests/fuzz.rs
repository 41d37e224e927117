//! The short form of `tools/fuzz wire`: every decoder meets some thousands of spoiled messages.

#[path = "fuzz/mod.rs"]
mod cases;

use cases::{Random, decoders};

#[test]
fn every_seed_is_read_as_what_it_is() {
    for decoder in decoders() {
        for (n, seed) in decoder.seeds().iter().enumerate() {
            assert!(decoder.decode(seed) > 0, "{} seed {n}", decoder.name);
        }
    }
}

#[test]
fn twenty_thousand_spoiled_messages_a_decoder_end_without_a_panic() {
    for decoder in decoders() {
        let seeds = decoder.seeds();
        let mut random = Random(0x9E37_79B9_7F4A_7C15);
        let mut lines = 0;
        for _ in 0..20_000 {
            lines += decoder.decode(&decoder.spoiled(&seeds, &mut random));
        }
        assert!(lines > 10_000, "{}: only {lines} lines", decoder.name);
    }
}
