//! Whose a secret is, and that nobody learns it who may not read it.

use super::*;

async fn revealed(w: &World) -> Value {
    let document = w.revealed("Service/s").await;
    document.spec["config"]["users"].clone()
}

/// Texts of the secrets of the users, after the list was put as `change` makes it of what is shown.
async fn after(w: &World, change: impl FnOnce(&mut Vec<Value>)) -> Result<Vec<String>, Problem> {
    let mut spec = (*w.get("Service/s").await.unwrap().spec).clone();
    change(spec["config"]["users"].as_array_mut().unwrap());
    w.try_put("Service/s", spec, Precondition::Any).await?;
    let texts = revealed(w).await;
    let texts = texts.as_array().unwrap().iter().map(|user| {
        let text = user["pw"]["$secret"]["text"].as_str().unwrap();
        format!("{}{text}", user["name"].as_str().unwrap_or_default())
    });
    Ok(texts.collect())
}

async fn users(list: Value) -> World {
    let w = world().await;
    w.put("Service/s", json!({ "config": { "users": list } })).await;
    w
}

fn user(name: &str, text: &str) -> Value {
    json!({ "name": name, "pw": { "$secret": text } })
}

async fn three() -> World {
    users(json!([user("a", "A"), user("b", "B"), user("c", "C")])).await
}

#[tokio::test]
async fn a_secret_in_a_list_stays_with_its_item() {
    let gone = |index: usize| move |list: &mut Vec<Value>| drop(list.remove(index));
    assert_eq!(after(&three().await, gone(0)).await.unwrap(), ["bB", "cC"]);
    assert_eq!(after(&three().await, gone(2)).await.unwrap(), ["aA", "bB"]);
    let appended = after(&three().await, |list| list.push(user("d", "D"))).await;
    assert_eq!(appended.unwrap(), ["aA", "bB", "cC", "dD"]);
    let first = after(&three().await, |list| list.insert(0, user("d", "D"))).await;
    assert_eq!(first.unwrap(), ["dD", "aA", "bB", "cC"]);
    let swapped = after(&three().await, |list| list.swap(0, 2)).await;
    assert_eq!(swapped.unwrap(), ["cC", "bB", "aA"]);
    let renamed = after(&three().await, |list| list[1]["name"] = "x".into()).await;
    assert_eq!(renamed.unwrap(), ["aA", "xB", "cC"]);
    let w = three().await;
    let text = after(&w, |list| list[1] = user("b", "new")).await;
    assert_eq!(text.unwrap(), ["aA", "bnew", "cC"]);
    assert_eq!(
        revealed(&w).await[0]["pw"]["$secret"]["version"],
        1,
        "the others are as old as they were"
    );
    // Edited and moved at once: nobody knows whose it is.
    for refused in [
        after(&three().await, |list| {
            list[1]["name"] = "x".into();
            list.remove(0);
        })
        .await,
        after(&three().await, |list| {
            list[1]["name"] = "x".into();
            list.swap(0, 2);
        })
        .await,
    ] {
        let problem = refused.unwrap_err();
        assert_eq!(problem.code, Code::SecretUnknown);
        assert!(problem.detail.contains("two steps"), "{problem}");
    }
}

#[tokio::test]
async fn items_that_look_the_same_are_told_apart_only_where_that_is_certain() {
    let twins = async || users(json!([user("", "A"), user("", "B")])).await;
    let problem = after(&twins().await, |list| drop(list.remove(0))).await.unwrap_err();
    assert_eq!(problem.code, Code::SecretUnknown);
    let appended = after(&twins().await, |list| list.push(user("", "C"))).await;
    assert_eq!(appended.unwrap(), ["A", "B", "C"]);
    let edited = after(&twins().await, |list| list[0] = user("", "C")).await;
    assert_eq!(edited.unwrap(), ["C", "B"]);
    let same = users(json!([user("", "A"), user("", "A")])).await;
    assert_eq!(after(&same, |list| drop(list.remove(0))).await.unwrap(), ["A"]);
    // A list within a list, and secrets that are items themselves.
    let w = world().await;
    let nested = json!({ "config": { "outer": [{ "n": 1, "in": [{ "$secret": "A" }, { "$secret": "B" }] },
        { "n": 2 }] } });
    w.put("Service/s", nested).await;
    let mut spec = (*w.get("Service/s").await.unwrap().spec).clone();
    spec["config"]["outer"].as_array_mut().unwrap().remove(1);
    let kept = w.put("Service/s", spec).await;
    assert_eq!(kept.spec["config"]["outer"][0]["in"][1]["$secret"]["version"], 1);
}

#[tokio::test]
async fn an_edited_item_keeps_its_own_secret_and_never_that_of_another() {
    // Told by the version of the secret: what was edited has moved to the place of one that is
    // gone.
    let w = three().await;
    after(&w, |list| list[1] = user("b", "newer")).await.unwrap();
    let moved = |list: &mut Vec<Value>| {
        let mut edited = list[1].clone();
        edited["port"] = 7.into();
        *list = vec![edited, user("d", "D"), list[2].clone()];
    };
    assert_eq!(after(&w, moved).await.unwrap(), ["bnewer", "dD", "cC"]);
    // The version is that of one that is still there itself.
    let w = users(json!([user("a", "A")])).await;
    after(&w, |list| list.push(user("b", "B"))).await.unwrap();
    let copied = after(&w, |list| {
        let copy = list[0].clone();
        list[1] = copy;
        list[1]["name"] = "x".into();
    });
    assert_eq!(code(copied.await), Code::SecretUnknown);
    // Of the same version: told by what they still have in common, or not at all.
    let two = async || users(json!([user("a", "A"), user("b", "B")])).await;
    let both = |list: &mut Vec<Value>| list.iter_mut().for_each(|user| user["port"] = 7.into());
    assert_eq!(after(&two().await, both).await.unwrap(), ["aA", "bB"]);
    let renamed = |list: &mut Vec<Value>| {
        list[0]["name"] = "x".into();
        list[1]["name"] = "y".into();
    };
    assert_eq!(after(&two().await, renamed).await.unwrap(), ["xA", "yB"]);
    let one = |list: &mut Vec<Value>| {
        list[0]["port"] = 7.into();
        list[1] = user("c", "C");
    };
    assert_eq!(after(&two().await, one).await.unwrap(), ["aA", "cC"]);
    let swapped = after(&two().await, |list| {
        both(list);
        list.swap(0, 1);
    })
    .await;
    assert_eq!(code(swapped), Code::SecretUnknown);
    let replaced = after(&two().await, |list| {
        list[1]["port"] = 7.into();
        *list = vec![list[1].clone(), user("c", "C")];
    })
    .await;
    assert_eq!(code(replaced), Code::SecretUnknown);
}

#[tokio::test]
async fn a_schema_learns_nothing_of_a_secret() {
    let w = world().await;
    w.put("Service/s", json!({ "config": { "pw": { "$secret": "BOB" } } })).await;
    let with = async |schema: Value| {
        let patch = json!({ "spec": { "schema": { "properties": { "pw": schema } } } });
        w.patch("Service/s", patch).await
    };
    w.put("Instance/s/0", json!({})).await;
    for schema in [
        json!({ "pattern": "^A" }),
        json!({ "pattern": "^B" }),
        json!({ "not": { "pattern": "^B" } }),
        json!({ "minLength": 4 }),
        json!({ "enum": ["A"] }),
        json!({ "type": "string", "const": "A" }),
    ] {
        let written = with(schema.clone()).await;
        assert!(written.is_ok(), "{schema}: {written:?}");
    }
    w.put("Layer/edge", json!({ "kind": "edge" })).await;
    let refused = with(json!({ "type": "integer" })).await.unwrap_err();
    assert_eq!(refused.code, Code::SchemaMismatch);
    assert_eq!(refused.errors[0].pointer, "/spec/config/pw");
}
