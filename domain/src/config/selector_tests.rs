use proptest::prelude::*;

use super::*;

fn labels(text: &str) -> Labels {
    let pairs = text.split(',').filter(|pair| !pair.is_empty());
    pairs
        .map(|pair| pair.split_once('=').unwrap())
        .map(|(key, value)| (key.to_owned(), value.to_owned()))
        .collect()
}

#[test]
fn selectors_match_as_in_kubernetes() {
    let these = labels("site=lab,tier=a,empty=,example.org/role=gateway");
    for (selector, expected) in [
        ("site=lab", true),
        ("site==lab", true),
        (" site = lab ", true),
        ("site=hall", false),
        ("other=lab", false),
        ("site!=hall", true),
        ("site!=lab", false),
        ("other!=lab", true),
        ("tier in (a,b)", true),
        ("tier in ( b , c )", false),
        ("other in (a)", false),
        ("tier notin (b)", true),
        ("tier notin (a, b)", false),
        ("other notin (a)", true),
        ("site", true),
        ("other", false),
        ("!site", false),
        ("! other", true),
        ("empty=", true),
        ("empty", true),
        ("site=", false),
        ("empty in ()", true),
        ("tier in (,a)", true),
        ("site=lab,tier=a,!spare", true),
        ("site=lab,tier=b", false),
        ("example.org/role=gateway", true),
        ("tier in(a),site", true),
        ("in", false),
    ] {
        let parsed: LabelSelector =
            selector.parse().unwrap_or_else(|error| panic!("{selector:?} {error}"));
        assert_eq!(parsed.matches(&these), expected, "{selector:?}");
        assert_eq!(parsed.to_string().parse::<LabelSelector>(), Ok(parsed), "{selector:?}");
    }
}

#[test]
fn what_is_no_selector_is_refused() {
    for (text, error) in [
        ("", "is empty; write a requirement, such as site=lab"),
        ("  ", "is empty; write a requirement, such as site=lab"),
        (",", "needs the key of a label at character 1"),
        ("a,", "needs the key of a label at character 3"),
        ("a=b,,c", "needs the key of a label at character 5"),
        ("=b", "needs the key of a label at character 1"),
        ("a b", "needs =, ==, !=, in, notin, a comma or the end at character 3"),
        ("a=b c", "needs a comma or the end at character 5"),
        ("a in b", "needs ( and values at character 6"),
        ("a in (b", "needs a comma or ) at character 8"),
        ("a in (b c)", "needs a comma or ) at character 9"),
        ("a>1", "needs =, ==, !=, in, notin, a comma or the end at character 2"),
        ("!", "needs the key of a label at character 2"),
        ("!a=b", "needs a comma or the end at character 3"),
        ("a===b", "needs a comma or the end at character 4"),
    ] {
        assert_eq!(text.parse::<LabelSelector>().unwrap_err().to_string(), error, "{text:?}");
    }
    for text in
        ["-a", "a=-b", "a/b/c", "A.b/c", "/a", "a/", "\u{e4}=b", "a=\u{e4}", "a in (b;c)", "a\nb"]
    {
        assert!(text.parse::<LabelSelector>().is_err(), "{text:?}");
    }
    let long = format!("a={}", "b".repeat(64));
    assert!(
        long.parse::<LabelSelector>()
            .unwrap_err()
            .to_string()
            .ends_with("which is longer than 63 bytes")
    );
    let huge = "a,".repeat(MAX_SELECTOR_BYTES);
    assert_eq!(huge.parse::<LabelSelector>(), Err(SelectorError::TooLong(2 * MAX_SELECTOR_BYTES)));
}

#[test]
fn keys_and_values_of_labels() {
    for key in
        ["a", "A-b_c.9", "example.org/a", &"a".repeat(63), &format!("{}/a", "a.".repeat(126) + "a")]
    {
        assert_eq!(check_label_key(key), Ok(()), "{key}");
    }
    for (key, error) in [
        ("", LabelError::Empty),
        ("x/", LabelError::Empty),
        ("/a", LabelError::Prefix),
        ("A/a", LabelError::Prefix),
        ("a..b/a", LabelError::Prefix),
        ("-a/a", LabelError::Prefix),
        ("a/b/c", LabelError::Form),
        ("-a", LabelError::Form),
        ("a.", LabelError::Form),
        ("a b", LabelError::Form),
        (&"a".repeat(64), LabelError::TooLong),
    ] {
        assert_eq!(check_label_key(key), Err(error), "{key}");
    }
    assert!(check_label_key(&format!("{}/a", "a.".repeat(127) + "a")).is_err());
    for value in ["", "a", "1.2-x_Y"] {
        assert_eq!(check_label_value(value), Ok(()), "{value}");
    }
    for value in ["-", "a-", "_a", "a/b", " ", &"a".repeat(64)] {
        assert!(check_label_value(value).is_err(), "{value}");
    }
}

proptest! {
    #[test]
    fn no_text_panics(text in "[a-b=!,() inot.\u{e4}\t]{0,20}") {
        if let Ok(selector) = text.parse::<LabelSelector>() {
            prop_assert_eq!(selector.to_string().parse::<LabelSelector>(), Ok(selector));
        }
    }

    #[test]
    fn opposites_differ(key in "[ab]", value in "[xy]?", other in "[xy]?", has in any::<bool>()) {
        let labels: Labels = has.then(|| ("a".to_owned(), other)).into_iter().collect();
        let matches = |text: String| text.parse::<LabelSelector>().unwrap().matches(&labels);
        prop_assert_ne!(matches(format!("{key}={value}")), matches(format!("{key}!={value}")));
        prop_assert_ne!(
            matches(format!("{key} in ({value},z)")),
            matches(format!("{key} notin ({value},z)")),
        );
        prop_assert_ne!(matches(key.clone()), matches(format!("!{key}")));
        let is = matches(format!("{key}={value}"));
        prop_assert!(!is || matches(key));
    }
}
