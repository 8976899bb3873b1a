//! Graphs as documents: their places, and their limits of size and time.
#![expect(clippy::unwrap_used, reason = "a test may")]

use std::sync::Arc;
use std::time::Duration;

use knowledge::{HttpEndpoint, Knowledge, KnowledgeSource, Queries, QueryLimits, SourceKind};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;

use crate::http::get;
use crate::writes::writes;

/// Returns a store with texts of `bytes` bytes altogether.
async fn site(limits: QueryLimits, bytes: usize) -> HttpEndpoint {
    let knowledge = Arc::new(Knowledge::new().unwrap());
    let texts: String = (0..16)
        .map(|number| {
            let text = "x".repeat(bytes / 16);
            format!("<urn:s{number}> <urn:p> \"{text}\" .\n")
        })
        .collect();
    let source = KnowledgeSource::new(SourceKind::File, "texts");
    knowledge.replace_turtle(&source, &texts, 5).unwrap();
    HttpEndpoint::bind_with(
        "127.0.0.1:0".parse().unwrap(),
        Queries::new(knowledge, limits),
        Arc::new(|_: &str| None),
        Some(writes(false)),
    )
    .await
    .unwrap()
}

const PATHS: [&str; 3] = [
    "/data",
    "/data?graph=urn:ua-bridge:graph:file:texts",
    "/store?graph=urn:ua-bridge:graph:file:texts",
];

#[tokio::test]
async fn graphs_beyond_the_limits_of_size_and_time_are_refused() {
    let small = QueryLimits {
        dump: 10_000,
        ..QueryLimits::default()
    };
    let endpoint = site(small, 16_000).await;
    for path in PATHS {
        let refused = get(endpoint.address(), path, "*/*").await;
        assert_eq!(refused.status, 507, "{path}");
        let is_named = refused.body.contains("result_limit") && refused.body.contains("10000");
        assert!(is_named, "{path}: {}", refused.body);
    }
    let quick = QueryLimits {
        time: Duration::ZERO,
        ..QueryLimits::default()
    };
    let endpoint = site(quick, 16_000).await;
    for path in PATHS {
        let refused = get(endpoint.address(), path, "*/*").await;
        assert_eq!(refused.status, 503, "{path}");
        assert!(refused.body.contains("time_limit"), "{}", refused.body);
    }
    let endpoint = site(QueryLimits::default(), 16_000).await;
    for path in PATHS {
        let answer = get(endpoint.address(), path, "*/*").await;
        assert_eq!(answer.status, 200, "{path}");
        assert!(answer.body.len() > 16_000, "{path}");
    }
}

#[tokio::test]
async fn a_graph_keeps_its_place_until_it_is_sent() {
    // More than the buffers of a connection hold.
    let slow = QueryLimits {
        time: Duration::from_secs(60),
        ..QueryLimits::default()
    };
    let endpoint = site(slow, 16 << 20).await;
    let at = endpoint.address();
    let mut unread = Vec::new();
    for _ in 0..2 {
        let mut stream = TcpStream::connect(at).await.unwrap();
        let request = "GET /data HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n";
        stream.write_all(request.as_bytes()).await.unwrap();
        // The head of the answer is there, so that its place is taken.
        let mut first = [0; 1];
        stream.read_exact(&mut first).await.unwrap();
        unread.push(stream);
    }
    let busy = get(at, PATHS[0], "*/*").await;
    assert_eq!(busy.status, 503);
    assert!(busy.body.contains("\"busy\""), "{}", busy.body);
    // Queries have other places.
    assert_eq!(get(at, "/ask/sources", "*/*").await.status, 200);
    drop(unread);
    let deadline = tokio::time::Instant::now() + Duration::from_secs(20);
    while get(at, PATHS[0], "*/*").await.status != 200 {
        let now = tokio::time::Instant::now();
        assert!(now < deadline, "a place of a closed connection stays taken");
    }
}
