use hyper::header::HeaderName;

use super::*;

const MEDIA: &str = "application/json";

fn headers(pairs: &[(&'static str, &'static str)]) -> HeaderMap {
    let pairs = pairs.iter();
    pairs
        .map(|(name, value)| {
            (
                HeaderName::from_static(name),
                HeaderValue::from_static(value),
            )
        })
        .collect()
}

fn is_from_page(pairs: &[(&'static str, &'static str)]) -> bool {
    check_origin(&headers(pairs), "http://localhost:9100", MEDIA).is_ok()
}

#[test]
fn a_request_from_another_site_is_refused() {
    const JSON: (&str, &str) = ("content-type", MEDIA);
    assert!(is_from_page(&[JSON]));
    assert!(is_from_page(&[
        JSON,
        ("origin", "http://localhost:9100"),
        ("sec-fetch-site", "same-origin")
    ]));
    assert!(!is_from_page(&[JSON, ("origin", "http://evil.example")]));
    assert!(!is_from_page(&[JSON, ("origin", "null")]));
    assert!(!is_from_page(&[JSON, ("sec-fetch-site", "same-site")]));
    assert!(!is_from_page(&[("content-type", "text/plain")]));
    assert!(!is_from_page(&[]));
    for (origin, is_own) in [
        ("https://cell.example", true),
        ("https://evil.example", false),
    ] {
        let sent = headers(&[JSON, ("origin", origin)]);
        let checked = check_origin(&sent, "https://cell.example", MEDIA);
        assert_eq!(checked.is_ok(), is_own);
    }
}

fn visit(peer: &str, is_secure: bool) -> Visit {
    let mut visit = Visit::from(peer.parse::<SocketAddr>().unwrap());
    visit.is_secure = is_secure;
    visit
}

#[test]
fn behind_a_proxy_users_sign_in_and_cookies_are_secure() {
    let here = visit("127.0.0.1:5000", false);
    let proxied = Page::new(
        "test",
        Vec::new(),
        Some("https://cell.example".parse().unwrap()),
    );
    let open = Page::new("test", Vec::new(), None);
    let of_proxy = headers(&[("host", "cell.example")]);
    assert!(open.host(&of_proxy, &here).is_err());
    let of_loopback = headers(&[("host", "localhost:9100")]);
    let there = visit("10.0.0.1:1", false);
    assert!(open.host(&of_loopback, &there).is_err());
    let forwarded = headers(&[("host", "127.0.0.1:9100"), ("x-forwarded-for", "10.0.0.1")]);
    assert!(open.host(&forwarded, &here).is_err());
    // A proxy may pass on the name of loopback, and another Host.
    for sent in [&of_proxy, &forwarded] {
        let (host, via) = proxied.host(sent, &here).ok().unwrap();
        assert_eq!(proxied.origin(&host, via), "https://cell.example");
        let browser = proxied.browser(&HeaderMap::new(), (host, via));
        assert!(check_reader(&browser).is_err());
        let cookie = browser.cookie("ab", 60);
        assert!(cookie.starts_with("__Host-ua-session=ab; Path=/;"));
        assert!(cookie.ends_with("; Secure"));
    }
    let of_loopback = headers(&[("host", "127.0.0.1:9100")]);
    let found = open.host(&of_loopback, &here).ok().unwrap();
    assert_eq!(open.origin(&found.0, found.1), "http://127.0.0.1:9100");
    let browser = open.browser(&HeaderMap::new(), found);
    assert!(check_reader(&browser).is_ok());
    let cookie = browser.cookie("ab", 60);
    assert!(cookie.starts_with("ua-session-9100=ab; Path=/;"));
    assert!(cookie.contains("HttpOnly; SameSite=Strict") && !cookie.contains("Secure"));
}

#[test]
fn by_tls_users_of_other_hosts_sign_in_and_other_names_are_refused() {
    let page = Page::new("test", Vec::new(), None);
    let there = visit("10.0.0.1:5000", true);
    let of_address = headers(&[("host", "10.0.0.2:9443")]);
    let found = page.host(&of_address, &there).ok().unwrap();
    assert_eq!(page.origin(&found.0, found.1), "https://10.0.0.2:9443");
    let browser = page.browser(&HeaderMap::new(), found);
    assert!(check_reader(&browser).is_err());
    assert!(browser.cookie("ab", 60).ends_with("; Secure"));
    let told = page.told(None, browser.via);
    assert_eq!(told["must_sign_in"], true);
    for other in ["evil.example", "", "localhost.evil.example"] {
        let sent = headers(&[("host", other)]);
        assert!(page.host(&sent, &there).is_err(), "{other}");
    }
}
