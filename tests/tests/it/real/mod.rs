//! Whole paths over real Redis and Kafka servers, with plain clients at both ends.

mod again;
mod balance;
mod churn;
mod contract;
mod demo;
mod frozen;
mod garbage;
mod gateways;
mod late;
mod numbered;
mod plain_clients;
mod replicas;
mod restarts;
mod scale;
mod support;
