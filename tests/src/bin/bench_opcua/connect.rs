//! Connections with each security policy.

use std::time::Instant;

use plant_opcua::client::{OpcUaClient, SecurityChoice};
use system_tests::{Cell, Times, per_message};

use crate::servers::{BenchServer, START, config, connected};

/// Measures from the start to a session in which a value was read. The endpoints are requested over
/// a separate connection.
pub(crate) async fn measure(cell: &Cell, servers: &[BenchServer], connects: usize) {
    println!("\n{connects} connections of each kind, in turns; milliseconds:\n");
    println!("| security | server | p50 | p99 | p50 / asyncua | CPU of the server |");
    println!("|---|---|---|---|---|---|");
    for (security, shown) in [
        (SecurityChoice::None, "None"),
        (SecurityChoice::Basic256Sha256, "Basic256Sha256"),
        (SecurityChoice::Aes128Sha256RsaOaep, "Aes128_Sha256_RsaOaep"),
        (SecurityChoice::Aes256Sha256RsaPss, "Aes256_Sha256_RsaPss"),
    ] {
        let mut rows = Vec::new();
        for server in servers {
            // The first connection creates certificates and stores them as trusted.
            let first = connected(cell, server.endpoint, security).await;
            first.close().await;
            rows.push((server, Times::default(), server.used()));
        }
        for _ in 0..connects {
            for (server, times, _) in &mut rows {
                let began = Instant::now();
                let client = OpcUaClient::open(config(cell, security), server.endpoint);
                client.up(START).await.unwrap();
                times.add(began.elapsed());
                client.close().await;
            }
        }
        let other = rows.iter_mut().find(|row| row.0.name == "asyncua");
        let other = other.map_or(f64::NAN, |row| row.1.at(0.5));
        for (server, mut times, before) in rows {
            let used = per_message(server.used() - before, times.count());
            let p50 = times.at(0.5);
            println!(
                "| {shown} | {} | {:.1} | {:.1} | {:.2} | {:.1} |",
                server.name,
                p50 / 1e3,
                times.at(0.99) / 1e3,
                p50 / other,
                used / 1e3
            );
        }
    }
}
