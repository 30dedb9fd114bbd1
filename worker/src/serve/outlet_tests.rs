//! A broker that is there, and a server of the keys that is not.

use blaze_brokers::memory::MemoryHub;
use blaze_brokers::{Content, SubscribeOptions};
use blaze_domain::node_file::NodeFile;
use serde_json::json;

use super::*;

/// A client of a Redis at a port where nobody listens.
fn nobody() -> Arc<RedisKeys> {
    let file = json!({
        "layer": { "name": "edge", "kind": "edge" },
        "brokers": { "node": { "memory": {} } },
        "cache": { "redis": { "url": "redis://127.0.0.1:1" } },
    });
    let (file, _) = NodeFile::read(&file).unwrap();
    Arc::new(RedisKeys::open(file.cache_redis().unwrap()).unwrap())
}

#[tokio::test]
async fn without_the_server_of_the_keys_it_is_said_that_they_alone_are_missing() {
    let hub = MemoryHub::new("node");
    let reader: Arc<dyn Broker> = Arc::new(hub.broker());
    let channel: ChannelName = "blaze/config/changed/slam".parse().unwrap();
    let mut notices = reader.subscribe(&channel, SubscribeOptions::default()).await.unwrap();
    let key = KeyChange::Put { key: "blaze:config:slam".to_owned(), value: Bytes::from("1") };
    let message = KeyedMessage { channel, key: String::new(), value: Some(Bytes::from("1")) };
    let outlet =
        BrokerOutlet::new(Arc::new(hub.broker())).with_keys(nobody(), false, None, |_| false);
    let told = outlet.deliver(std::slice::from_ref(&key), std::slice::from_ref(&message)).await;
    assert!(matches!(told, Err(OutletError::KeysAlone(KeyError::Away { .. }))), "{told:?}");
    outlet.deliver(&[], std::slice::from_ref(&message)).await.unwrap();
    let mut heard = Vec::new();
    assert_eq!(notices.receive(&mut heard, 9).await, 1);
    assert!(matches!(&heard[0].content, Content::Bare { payload, .. } if payload == "1"));
    let alone = outlet.deliver(std::slice::from_ref(&key), &[]).await;
    assert!(matches!(alone, Err(OutletError::KeysAlone(KeyError::Away { .. }))), "{alone:?}");
    // Where both are one server, both come or none does.
    let outlet =
        BrokerOutlet::new(Arc::new(hub.broker())).with_keys(nobody(), true, None, |_| false);
    let told = outlet.deliver(&[key], &[message]).await;
    assert!(matches!(told, Err(OutletError::Keys(KeyError::Away { .. }))), "{told:?}");
}
