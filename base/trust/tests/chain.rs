//! Tests of certificate validation: certificates of an authority are accepted, and each fault has
//! its status code. The keys of `tests/keys` are used by these tests only.
#![expect(
    clippy::unwrap_used,
    reason = "a test may, also in what its cases share"
)]

use std::time::Duration;

use trust::{
    Certificate, CertificateAuthority, CertificateFault, CertificateSigningRequest, Crl, Issue,
    Renewal, RenewalStep, RequiredNames, Revoked, Serial, TrustedCertificates, Unfit, check,
    check_named,
};
use x509_cert::der::pem;

const AUTHORITY: &[u8] = include_bytes!("keys/authority.pem");
const OTHER: &[u8] = include_bytes!("keys/between.pem");
const DEVICE: &[u8] = include_bytes!("keys/device.pem");
const SHORT: &[u8] = include_bytes!("keys/short.pem");
const DAY: Duration = Duration::from_secs(86_400);
/// A day in 2026.
const NOW: Duration = Duration::from_secs(1_795_000_000);

fn key(pem: &[u8]) -> Vec<u8> {
    pem::decode_vec(pem).unwrap().1
}

fn issue(number: u8, from: Duration, until: Duration) -> Issue {
    Issue {
        serial: Serial::random([number; 16]),
        from,
        until,
    }
}

fn authority(pem: &[u8], name: &str) -> CertificateAuthority {
    let life = issue(1, NOW - DAY * 100, NOW + DAY * 100);
    CertificateAuthority::make(&key(pem), (name, "Plant"), &life).unwrap()
}

fn request() -> CertificateSigningRequest {
    let hosts = [
        "cell-1".to_owned(),
        "192.0.2.7".to_owned(),
        "[::1]".to_owned(),
    ];
    CertificateSigningRequest::make(&key(DEVICE), "urn:cell:robot", ("Robot", "Plant"), &hosts)
        .unwrap()
}

struct Cell {
    authority: CertificateAuthority,
    device: Certificate,
    known: TrustedCertificates,
}

fn cell() -> Cell {
    let authority = authority(AUTHORITY, "Plant authority");
    let device = authority
        .issue(&request(), &issue(7, NOW - DAY, NOW + DAY))
        .unwrap();
    let known = TrustedCertificates {
        trusted: vec![authority.certificate().clone()],
        crls: vec![authority.crl(&[], 1, (NOW - DAY, NOW + DAY)).unwrap()],
        ..TrustedCertificates::default()
    };
    Cell {
        authority,
        device,
        known,
    }
}

#[test]
fn what_a_trusted_authority_issued_is_taken_and_says_what_was_asked_for() {
    let Cell {
        device,
        known,
        authority,
    } = cell();
    assert_eq!(check(&device, &[], &known, NOW), Ok(()));
    assert_eq!(device.application_uri().as_deref(), Some("urn:cell:robot"));
    assert_eq!(
        (device.name(), device.issuer_name()),
        ("Robot".to_owned(), "Plant authority".to_owned())
    );
    for (host, fits) in [
        ("CELL-1", true),
        ("192.0.2.7", true),
        ("::1", true),
        ("cell-2", false),
    ] {
        assert_eq!(device.is_for_host(host), fits, "{host}");
    }
    assert!(!device.is_authority() && authority.certificate().is_authority());
    let read = Certificate::read(device.pem().as_bytes()).unwrap();
    assert_eq!(read, device);
}

#[test]
fn each_fault_has_its_status() {
    let Cell {
        authority,
        device,
        known,
    } = cell();
    let without_list = TrustedCertificates {
        crls: Vec::new(),
        ..known.clone()
    };
    assert_eq!(
        check(&device, &[], &without_list, NOW),
        Err(CertificateFault::RevocationUnknown)
    );
    assert_eq!(
        check(&device, &[], &TrustedCertificates::default(), NOW),
        Err(CertificateFault::Incomplete)
    );
    assert_eq!(
        check(&device, &[], &known, NOW + DAY * 2),
        Err(CertificateFault::Time)
    );
    // The certificate is still valid, but the revocation list has expired.
    let long = authority
        .issue(&request(), &issue(8, NOW - DAY, NOW + DAY * 100))
        .unwrap();
    assert_eq!(
        check(&long, &[], &known, NOW + DAY * 2),
        Err(CertificateFault::RevocationUnknown)
    );
    let revoked = [Revoked {
        serial: device.serial(),
        since: NOW,
    }];
    let list = authority.crl(&revoked, 2, (NOW, NOW + DAY)).unwrap();
    let listed = TrustedCertificates {
        crls: vec![list],
        ..known.clone()
    };
    assert_eq!(
        check(&device, &[], &listed, NOW),
        Err(CertificateFault::Revoked)
    );
    assert_eq!(check(&long, &[], &listed, NOW), Ok(()), "the others stay");
    // Another authority with the same name.
    let impostor = self::authority(OTHER, "Plant authority");
    let forged = impostor
        .issue(&request(), &issue(7, NOW - DAY, NOW + DAY))
        .unwrap();
    assert_eq!(
        check(&forged, &[], &known, NOW),
        Err(CertificateFault::Invalid)
    );
    let sent = [impostor.certificate().clone()];
    assert_eq!(
        check(&forged, &sent, &known, NOW),
        Err(CertificateFault::Untrusted),
        "what is sent along is not trusted for it"
    );
    // The revocation list of another authority does not count.
    let list = impostor.crl(&[], 9, (NOW, NOW + DAY)).unwrap();
    let foreign = TrustedCertificates {
        crls: vec![list],
        ..known
    };
    assert_eq!(
        check(&device, &[], &foreign, NOW),
        Err(CertificateFault::RevocationUnknown)
    );
    assert_eq!(CertificateFault::Revoked.status(), 0x801D_0000);
    assert!(
        CertificateFault::Revoked.may_be_told()
            && !CertificateFault::Untrusted.may_be_told()
            && !CertificateFault::Invalid.may_be_told()
    );
}

#[test]
fn the_certificate_of_a_server_is_for_its_host_and_of_its_application() {
    let Cell { device, known, .. } = cell();
    let named = |host, application_uri, now| {
        let names = RequiredNames {
            host,
            application_uri,
        };
        check_named(&device, &[], &known, (names, now))
    };
    let (host, uri) = (Some("cell-1"), Some("urn:cell:robot"));
    assert_eq!(named(host, uri, NOW), Ok(()));
    assert_eq!(named(Some("[0:0::1]"), None, NOW), Ok(()));
    assert_eq!(named(Some("cell-2"), uri, NOW), Err(CertificateFault::Host));
    assert_eq!(
        named(host, Some("urn:cell:other"), NOW),
        Err(CertificateFault::Uri)
    );
    // The earlier check decides.
    assert_eq!(
        named(Some("cell-2"), uri, NOW + DAY * 2),
        Err(CertificateFault::Time)
    );
    assert_eq!(CertificateFault::Host.status(), 0x8016_0000);
    assert_eq!(CertificateFault::Uri.status(), 0x8017_0000);
}

#[test]
fn one_that_is_trusted_itself_needs_no_authority_but_is_refused_when_it_is_revoked() {
    let Cell {
        authority, device, ..
    } = cell();
    let mut known = TrustedCertificates {
        trusted: vec![device.clone()],
        ..TrustedCertificates::default()
    };
    assert_eq!(check(&device, &[], &known, NOW), Ok(()));
    let revoked = [Revoked {
        serial: device.serial(),
        since: NOW,
    }];
    known.issuers.push(authority.certificate().clone());
    known
        .crls
        .push(authority.crl(&revoked, 2, (NOW, NOW + DAY)).unwrap());
    assert_eq!(
        check(&device, &[], &known, NOW),
        Err(CertificateFault::Revoked)
    );
}

#[test]
fn what_an_application_issued_is_refused() {
    let Cell { device, known, .. } = cell();
    // A forged authority with the key and the name of the device.
    let fake = CertificateAuthority::make(
        &key(DEVICE),
        ("Robot", "Plant"),
        &issue(2, NOW - DAY, NOW + DAY),
    )
    .unwrap();
    assert!(matches!(
        CertificateAuthority::open(device, &key(DEVICE)),
        Err(Unfit::Key)
    ));
    let other =
        CertificateSigningRequest::make(&key(OTHER), "urn:cell:other", ("Other", ""), &[]).unwrap();
    let issued = fake.issue(&other, &issue(9, NOW - DAY, NOW + DAY)).unwrap();
    assert_eq!(
        check(&issued, &[], &known, NOW),
        Err(CertificateFault::Incomplete)
    );
}

#[test]
fn an_authority_that_is_over_is_told_of() {
    let Cell {
        authority, known, ..
    } = cell();
    let long = issue(9, NOW - DAY, NOW + DAY * 500);
    let device = authority.issue(&request(), &long).unwrap();
    assert_eq!(
        device.validity().1,
        authority.certificate().validity().1,
        "it ends with its authority"
    );
    let after = NOW + DAY * 101;
    assert_eq!(
        check(&device, &[], &known, after),
        Err(CertificateFault::Time)
    );
    // A certificate beyond the validity of its authority, as issued by other software.
    let short = CertificateAuthority::make(
        &key(AUTHORITY),
        ("Plant authority", "Plant"),
        &issue(3, NOW - DAY, NOW + DAY),
    )
    .unwrap();
    let known = TrustedCertificates {
        trusted: vec![short.certificate().clone()],
        ..known
    };
    assert_eq!(
        check(&device, &[], &known, NOW + DAY * 2),
        Err(CertificateFault::IssuerTime)
    );
}

#[test]
fn a_chain_is_read_as_it_is_sent() {
    let Cell {
        authority, device, ..
    } = cell();
    let both = [device.der(), authority.certificate().der()].concat();
    let (own, above) = Certificate::read_chain(&both).unwrap();
    assert_eq!(
        (own, above),
        (device.clone(), vec![authority.certificate().clone()])
    );
    for cut in 0..both.len() {
        let read = Certificate::read_chain(&both[..cut]);
        assert_eq!(read.is_ok(), cut == device.der().len(), "{cut}");
    }
}

#[test]
fn a_request_is_taken_of_who_has_the_key_and_names_an_application() {
    let made = request();
    let read = CertificateSigningRequest::read(made.der()).unwrap();
    assert_eq!(
        (read.application_uri(), read.hosts()),
        ("urn:cell:robot", made.hosts())
    );
    let mut changed = made.der().to_vec();
    let at = changed
        .windows(5)
        .position(|five| five == b"robot")
        .unwrap();
    changed[at] = b'R';
    assert!(matches!(
        CertificateSigningRequest::read(&changed),
        Err(Unfit::Signature)
    ));
    let short = CertificateSigningRequest::make(&key(SHORT), "urn:cell:robot", ("Robot", ""), &[]);
    assert!(matches!(short, Err(Unfit::Length(1024))));
    assert!(matches!(
        CertificateSigningRequest::read(b"-----BEGIN nothing"),
        Err(Unfit::Unreadable)
    ));
    let long =
        CertificateSigningRequest::make(&key(DEVICE), "urn:cell:robot", (&"x".repeat(65), ""), &[]);
    assert!(matches!(long, Err(Unfit::Name)));
}

#[test]
fn a_list_is_read_as_it_was_signed() {
    let Cell {
        authority, device, ..
    } = cell();
    let revoked = [Revoked {
        serial: device.serial(),
        since: NOW,
    }];
    let list = authority.crl(&revoked, 3, (NOW, NOW + DAY)).unwrap();
    let read = Crl::read(list.der()).unwrap();
    assert_eq!(read.revoked().collect::<Vec<_>>(), revoked);
    assert!(read.is_of(authority.certificate()) && read.revokes(&device));
    assert!(read.is_current(NOW) && !read.is_current(NOW + DAY * 2) && !read.is_current(NOW - DAY));
}

#[test]
fn serial_numbers_are_written_and_read() {
    let serial = Serial::random([0xff; 16]);
    assert_eq!(Serial::parse(&serial.to_string()), Some(serial));
    for wrong in ["", "1", "zz", &"11".repeat(21), "é1"] {
        assert_eq!(Serial::parse(wrong), None, "{wrong}");
    }
}

#[test]
fn a_certificate_is_asked_for_at_four_fifths_of_its_life_and_again_while_that_fails() {
    let Cell { device, .. } = cell();
    let mut plan = Renewal::of(&device);
    let due = NOW - DAY + DAY * 2 / 5 * 4;
    assert_eq!(plan.step(NOW), RenewalStep::Wait { until: due });
    assert_eq!(plan.step(due), RenewalStep::Ask);
    plan.failed(due);
    assert_eq!(
        plan.step(due),
        RenewalStep::Wait {
            until: due + Duration::from_secs(30)
        }
    );
    let mut at = due;
    for _ in 0..40 {
        let RenewalStep::Wait { until } = plan.step(at) else {
            panic!("it was asked for just now")
        };
        assert!(until > at && until - at <= Duration::from_secs(3600));
        at = until;
        let over = at > device.validity().1;
        assert_eq!(
            plan.step(at),
            if over {
                RenewalStep::Late
            } else {
                RenewalStep::Ask
            }
        );
        plan.failed(at);
    }
}

#[test]
fn a_certificate_that_an_application_made_itself_is_replaced_at_once() {
    let Cell { authority, .. } = cell();
    let mut plan = Renewal::of(authority.certificate());
    let mut at = NOW;
    let mut pauses = Vec::new();
    for _ in 0..40 {
        assert_eq!(plan.step(at), RenewalStep::Ask);
        plan.failed(at);
        let RenewalStep::Wait { until } = plan.step(at) else {
            panic!("it was requested just now")
        };
        pauses.push((until - at).as_secs());
        at = until;
    }
    assert_eq!(&pauses[..7], [2, 4, 8, 16, 32, 60, 60]);
    assert!(pauses.iter().skip(6).all(|pause| *pause == 60));
}

proptest::proptest! {
    #[test]
    fn no_bytes_are_too_bad_to_be_refused(bytes in proptest::collection::vec(proptest::prelude::any::<u8>(), 0..300)) {
        drop(Certificate::read(&bytes));
        drop(Certificate::read_chain(&bytes));
        drop(Crl::read(&bytes));
        drop(CertificateSigningRequest::read(&bytes));
    }
}

#[test]
fn a_request_carries_a_challenge_that_debug_output_leaves_out() {
    let hosts = ["cell-1".to_owned()];
    let names = ("Robot", "Plant");
    let with = |challenge| {
        let made = CertificateSigningRequest::make_with(
            &key(DEVICE),
            ("urn:cell:robot", &hosts),
            names,
            challenge,
        );
        CertificateSigningRequest::read(made.unwrap().der()).unwrap()
    };
    let invited = with(Some("3f9a-secret"));
    assert_eq!(invited.challenge(), Some("3f9a-secret"));
    assert!(!format!("{invited:?}").contains("secret"));
    assert_eq!(with(None).challenge(), None);
    let cell = cell();
    assert_eq!(invited.key_fingerprint(), cell.device.key_fingerprint());
    assert_ne!(
        invited.key_fingerprint(),
        cell.authority.certificate().key_fingerprint()
    );
}

#[test]
fn people_are_warned_of_the_end_of_an_authority_while_they_can_replace_it() {
    let ends = |days: u32, left: u32| {
        let life = issue(1, NOW - DAY * (days - left), NOW + DAY * left);
        let made =
            CertificateAuthority::make(&key(AUTHORITY), ("Plant authority", ""), &life).unwrap();
        trust::is_near_end(made.certificate(), NOW)
    };
    assert!(!ends(3650, 731) && ends(3650, 729));
    assert!(!ends(1000, 366) && ends(1000, 364));
    assert!(!ends(100, 21) && ends(100, 19));
}
