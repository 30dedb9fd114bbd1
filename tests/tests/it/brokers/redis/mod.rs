//! The Redis adapter, on Redis and on Valkey: the rules for all adapters, and what is special to a
//! server like this.

mod access;
mod kept;
mod keys;
mod outages;
mod owner;
mod support;

/// The rules for all adapters, each on a server of its own.
mod conformance_redis {
    use super::support::Server;
    use blaze_tests::servers::RedisKind;

    blaze_conformance::broker_conformance_tests!(async { Server::start(RedisKind::Redis) });
}

/// The same on Valkey.
mod conformance_valkey {
    use super::support::Server;
    use blaze_tests::servers::RedisKind;

    blaze_conformance::broker_conformance_tests!(async { Server::start(RedisKind::Valkey) });
}
