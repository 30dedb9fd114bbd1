//! `--dev`: no token is needed, so only programs of this machine may come, and no web page that a
//! browser here shows.

use std::net::IpAddr;

use blaze_auth::{Claims, Role};

/// Whom every request without a token comes from.
#[must_use]
pub fn claims() -> Claims {
    Claims {
        subject: "dev".to_owned(),
        // Also as a worker of any layer: whoever tries the system out on one machine has no tokens
        // for that either.
        roles: vec![Role::Admin.as_str().to_owned(), Role::Worker.as_str().to_owned()],
        layer: None,
        expires_s: None,
        token_id: None,
    }
}

/// Whether a `Host` header (or `:authority`) names this machine by its loopback name or address. A
/// page of another name that resolves to 127.0.0.1 (DNS rebinding) names itself there.
#[must_use]
pub fn host_is_loopback(host: &str) -> bool {
    let Some((name, _)) = split_host(host) else {
        return false;
    };
    let address = name.strip_prefix('[').and_then(|name| name.strip_suffix(']')).unwrap_or(name);
    match address.parse::<IpAddr>() {
        Ok(address) => address.to_canonical().is_loopback(),
        Err(_) => name.eq_ignore_ascii_case("localhost"),
    }
}

/// Whether a request with this `Origin` comes from a page that was not served under this `Host`.
#[must_use]
pub fn origin_is_foreign(origin: &str, host: &str) -> bool {
    let of_scheme =
        |scheme: &str, port: u16| origin.strip_prefix(scheme).map(|authority| (authority, port));
    let Some((authority, port)) = of_scheme("http://", 80).or_else(|| of_scheme("https://", 443))
    else {
        return true;
    };
    match (split_host(authority), split_host(host)) {
        (Some((name, own_port)), Some((other_name, other_port))) => {
            !name.eq_ignore_ascii_case(other_name)
                || own_port.unwrap_or(port) != other_port.unwrap_or(port)
        }
        _ => true,
    }
}

/// Name (an IPv6 address with its brackets) and port.
fn split_host(host: &str) -> Option<(&str, Option<u16>)> {
    let after_name = match host.strip_prefix('[') {
        Some(rest) => rest.find(']')? + 2,
        None => host.find(':').unwrap_or(host.len()),
    };
    let (name, rest) = host.split_at(after_name);
    let port = match rest.strip_prefix(':') {
        // `+80` would parse too.
        Some(port) if port.bytes().all(|byte| byte.is_ascii_digit()) => Some(port.parse().ok()?),
        Some(_) => return None,
        None if rest.is_empty() => None,
        None => return None,
    };
    let plain = |byte: u8| byte.is_ascii_alphanumeric() || b"-_.:[]".contains(&byte);
    (!name.is_empty() && name.bytes().all(plain)).then_some((name, port))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn only_loopback_hosts_are_taken() {
        for host in [
            "localhost",
            "LOCALHOST:8080",
            "127.0.0.1",
            "127.0.0.1:1",
            "127.9.8.7:65535",
            "[::1]",
            "[::1]:8080",
            "[::ffff:127.0.0.1]:80",
        ] {
            assert!(host_is_loopback(host), "{host}");
        }
        for host in [
            "",
            ":8080",
            "example.org",
            "localhost.example.org",
            "127.0.0.1.nip.io",
            "localhost:",
            "localhost:99999",
            "localhost:+80",
            "localhost:80:80",
            "0.0.0.0",
            "10.0.0.1:8080",
            "::1",
            "[::1",
            "[::]:80",
            "[::1]x",
            "a@localhost",
            "localhost/x",
            "2130706433",
        ] {
            assert!(!host_is_loopback(host), "{host}");
        }
    }

    #[test]
    fn origins_must_be_the_host() {
        for (origin, host) in [
            ("http://localhost:8080", "localhost:8080"),
            ("http://LOCALHOST:8080", "localhost:8080"),
            ("http://localhost", "localhost:80"),
            ("https://127.0.0.1:443", "127.0.0.1"),
            ("http://[::1]:8080", "[::1]:8080"),
        ] {
            assert!(!origin_is_foreign(origin, host), "{origin} {host}");
        }
        for (origin, host) in [
            ("null", "localhost:8080"),
            ("", "localhost:8080"),
            ("http://localhost:3000", "localhost:8080"),
            ("http://localhost:8080/", "localhost:8080"),
            ("http://evil.example:8080", "localhost:8080"),
            ("http://localhost:8080@evil.example", "localhost:8080"),
            ("file://localhost:8080", "localhost:8080"),
            ("http://127.0.0.1:8080", "localhost:8080"),
            ("http://", ""),
        ] {
            assert!(origin_is_foreign(origin, host), "{origin} {host}");
        }
        assert_eq!(claims().roles, ["admin", "worker"]);
    }

    proptest! {
        #[test]
        fn no_text_panics(origin in ".{0,40}", host in "[a-z0-9:.\\[\\]]{0,30}") {
            let _ =
                (host_is_loopback(&origin), host_is_loopback(&host),
                origin_is_foreign(&origin, &host));
        }
    }
}
