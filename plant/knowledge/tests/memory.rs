//! A query that uses all memory. It is in a program of its own, because all queries of a program
//! share its memory.

use std::sync::Arc;
use std::time::Duration;

use knowledge::{HttpEndpoint, Knowledge, KnowledgeSource, QueryLimits, SourceKind};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;

/// Sorts the cross product of all statements, which has to be in memory as a whole.
const GROWING: &str = "SELECT%20*%20%7B%20?a%20?b%20?c%20.%20?d%20?e%20?f%20.%20?g%20?h%20?i%20%7D%20ORDER%20BY%20?c%20?f%20?i";

#[tokio::test]
async fn a_query_that_takes_all_memory_is_stopped_and_the_next_one_answered() {
    let knowledge = Arc::new(Knowledge::new().unwrap());
    let many: String = (0..150)
        .map(|number| format!("<urn:s{number}> <urn:p> {number} .\n"))
        .collect();
    knowledge
        .replace_turtle(&KnowledgeSource::new(SourceKind::File, "many"), &many, 5)
        .unwrap();
    let limits = QueryLimits {
        parallel: 1,
        memory: 64 << 20,
        time: Duration::from_secs(60),
        ..QueryLimits::default()
    };
    let endpoint = HttpEndpoint::bind(
        "127.0.0.1:0".parse().unwrap(),
        knowledge,
        limits,
        Arc::new(|_: &str| None),
    )
    .await
    .unwrap();
    let get = async |path: &str| {
        let mut stream = TcpStream::connect(endpoint.address()).await.unwrap();
        let request =
            format!("GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n");
        stream.write_all(request.as_bytes()).await.unwrap();
        let mut answer = String::new();
        tokio::time::timeout(Duration::from_secs(60), stream.read_to_string(&mut answer))
            .await
            .unwrap()
            .unwrap();
        answer
    };
    let stopped = get(&format!("/sparql?query={GROWING}")).await;
    assert!(
        stopped.starts_with("HTTP/1.1 507") && stopped.contains("\"memory_limit\""),
        "{stopped}"
    );
    let deadline = tokio::time::Instant::now() + Duration::from_secs(20);
    while !get("/sparql?query=ASK%7B%3Furn%20?p%201%7D")
        .await
        .contains("true")
    {
        assert!(
            tokio::time::Instant::now() < deadline,
            "the thread of the stopped query did not end"
        );
    }
}
