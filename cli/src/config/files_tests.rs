use std::fs;

use serde_json::json;

use super::*;

const TWO: &str = "# robots\nkind: Node\nname: robot-1\nspec: { layer: edge }\n---\n# the second\n\nkind: Node\nname: robot-2\n";

fn read_text(name: &str, text: &str) -> Result<Vec<Source>, CliError> {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join(name);
    fs::write(&file, text).unwrap();
    read_from(&[file], &mut std::io::empty()).map_err(|error| match error {
        CliError::Invalid(text) => {
            CliError::Invalid(text.replace(&format!("{}/", directory.path().display()), ""))
        }
        other => other,
    })
}

fn faults(name: &str, text: &str) -> String {
    let error = read_text(name, text).unwrap_err();
    assert_eq!(error.exit() as u8, 7);
    error.to_string()
}

#[test]
fn documents_know_where_they_come_from() {
    let mut stdin = TWO.as_bytes();
    let sources = read_from(&[PathBuf::from("-")], &mut stdin).unwrap();
    let places: Vec<String> = sources.iter().map(|source| source.origin.to_string()).collect();
    assert_eq!(places, ["stdin:2 (document 1)", "stdin:8 (document 2)"]);
    assert_eq!(sources[0].value["spec"]["layer"], "edge");
    assert_eq!(sources[1].key.to_string(), "Node/robot-2");
    let one = read_from(&[PathBuf::from("-")], &mut "kind: Node\nname: a\n".as_bytes()).unwrap();
    assert_eq!(one[0].origin.to_string(), "stdin:1");
}

#[test]
fn every_fault_has_its_place_and_nothing_is_taken() {
    assert!(faults("a.yaml", "kind: Node\nname: a\nname: b\n").contains("a.yaml:3"), "given twice");
    let text = faults("a.yaml", "kind: Node\nname: A\n---\nkind: Nod\nname: b\n---\njust text\n");
    for part in [
        "a.yaml:1 (document 1): name",
        "a.yaml:4 (document 2): kind",
        "did you mean Node?",
        "a.yaml:7 (document 3)",
    ] {
        assert!(text.contains(part), "{part} in {text}");
    }
    let text = faults("a.json", "[{\"kind\":\"Node\",\n\"name\":\"a\",\"name\":\"b\"}]");
    assert!(text.contains("a.json:2"), "{text}");
    assert!(faults("a.yaml", "kind: [\n").contains("a.yaml"));
}

#[test]
fn json_comes_as_one_document_a_list_or_what_get_prints() {
    let node = json!({"kind": "Node", "name": "a", "spec": {}});
    for text in [
        node.to_string(),
        json!([node]).to_string(),
        json!({"items": [node], "revision": 7, "next_page_token": ""}).to_string(),
    ] {
        let sources = read_text("a.json", &text).unwrap();
        assert_eq!(sources.len(), 1);
        assert_eq!(sources[0].value, node);
        let mut stdin = text.as_bytes();
        assert_eq!(read_from(&[PathBuf::from("-")], &mut stdin).unwrap()[0].value, node);
    }
}

#[test]
fn standard_input_that_begins_like_json_may_be_yaml() {
    let read_stdin = |text: &str| read_from(&[PathBuf::from("-")], &mut text.as_bytes());
    let layer = json!({"kind": "Layer", "name": "fog", "spec": {"kind": "fog"}});
    for text in [
        "{ kind: Layer, name: fog, spec: { kind: fog } }\n",
        "[{ kind: Layer, name: fog, spec: { kind: fog } }]\n",
        "{\"kind\": \"Layer\", \"name\": \"fog\", \"spec\": {\"kind\": \"fog\"}}\n---\n# no more\n",
    ] {
        let sources = read_stdin(text).unwrap();
        assert_eq!(sources.len(), 1, "{text}");
        assert_eq!(sources[0].value, layer, "{text}");
    }
    let two = read_stdin("{ kind: Layer, name: fog }\n---\n{ kind: Layer, name: edge }\n").unwrap();
    assert_eq!(two[1].origin.to_string(), "stdin:3 (document 2)");
    // What is wrong is told in the terms of what was meant.
    let told = |text: &str| read_stdin(text).unwrap_err().to_string();
    let text = told("{\"kind\": \"Node\",\n\"name\": \"a\", \"name\": \"b\"}");
    assert!(text.starts_with("stdin:2: "), "{text}");
    assert!(told("{ kind: Layer, name: [ }\n").contains("stdin"), "flow that does not end");
}

#[test]
fn small_files_are_bounded_and_named() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("token");
    let told = |file: &Path| small(file, "the token file").unwrap_err().to_string();
    assert!(told(&file).starts_with("the token file /") && told(&file).ends_with("no such file"));
    fs::write(&file, vec![b'x'; 2 * 1024 * 1024]).unwrap();
    assert!(told(&file).contains("is larger than"), "{}", told(&file));
    assert!(told(Path::new("/dev/zero")).contains("is larger than"));
}

#[test]
fn directories_give_their_files_in_order() {
    let directory = tempfile::tempdir().unwrap();
    for (name, node) in [("b.yml", "b"), ("a.yaml", "a"), ("c.json", "c"), ("d.txt", "d")] {
        let text = format!("{{\"kind\": \"Node\", \"name\": \"{node}\"}}");
        fs::write(directory.path().join(name), text).unwrap();
    }
    fs::create_dir(directory.path().join("e.yaml")).unwrap();
    let sources = read(&[directory.path().to_owned()]).unwrap();
    let names: Vec<&str> = sources.iter().map(|source| source.key.name().as_str()).collect();
    assert_eq!(names, ["a", "b", "c"]);
    let error = read(&[directory.path().join("e.yaml")]).unwrap_err();
    assert_eq!(error.exit() as u8, 2);
}

#[test]
fn what_is_too_much_is_refused_before_anything_is_sent() {
    let many = "---\nkind: Node\nname: a\n".repeat(MAX_DOCUMENTS + 1);
    assert!(read_text("a.yaml", &many).is_err());
    let large = format!("# {}\n", "x".repeat(MAX_BYTES));
    let error = read_text("a.yaml", &large).unwrap_err();
    assert!(error.to_string().contains("more than 8 MiB"), "{error}");
    let twice = [PathBuf::from("-"), PathBuf::from("-")];
    assert_eq!(read_from(&twice, &mut std::io::empty()).unwrap_err().exit() as u8, 2);
    let error = read(&[PathBuf::from("/no/such/file.yaml")]).unwrap_err();
    assert!(error.to_string().contains("/no/such/file.yaml"), "{error}");
}
