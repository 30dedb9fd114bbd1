// A node without ROS: a participant of Fast DDS whose messages are CDR, byte by byte, with DDS's own defaults and neither
// user data nor a graph. fastdds_peer.py gives it commands, one a line, and ends it by the end of its input.
//
//   writer|reader NAME TOPIC TYPE RELIABLE DURABLE DEPTH DEADLINE LEASE LIFESPAN    0 or 1; milliseconds, 0 = none
//   write NAME BYTES, and so many bytes
//   delete NAME
//
// It answers each with `done` or `failed WORDS`. Beside that it says `met NAME COUNT`, and `got NAME BYTES` and the bytes.

#include <cstdlib>
#include <cstring>
#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/DataWriterListener.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/DataReaderListener.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <functional>
#include <iostream>
#include <map>
#include <mutex>
#include <sstream>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

using namespace eprosima::fastdds::dds;
using eprosima::fastrtps::rtps::InstanceHandle_t;
using eprosima::fastrtps::rtps::MemoryManagementPolicy_t;
using eprosima::fastrtps::rtps::SerializedPayload_t;
using Bytes = std::vector<char>;

static std::mutex output;

static void say(const std::string& line, const Bytes& bytes = {})
{
    std::lock_guard<std::mutex> one(output);
    std::cout << line << '\n';
    std::cout.write(bytes.data(), static_cast<std::streamsize>(bytes.size())).flush();
}

// Its values are CDR already.
class Raw : public TopicDataType
{
public:
    explicit Raw(const std::string& name)
    {
        setName(name.c_str());
        m_typeSize = 1024; // Of the first buffer; histories make others as they need.
        m_isGetKeyDefined = false;
        auto_fill_type_object(false);
        auto_fill_type_information(false);
    }

    bool serialize(void* data, SerializedPayload_t* payload) override
    {
        auto bytes = static_cast<Bytes*>(data);
        payload->encapsulation = CDR_LE;
        payload->length = static_cast<uint32_t>(bytes->size());
        std::memcpy(payload->data, bytes->data(), bytes->size());
        return true;
    }

    bool deserialize(SerializedPayload_t* payload, void* data) override
    {
        static_cast<Bytes*>(data)->assign(payload->data, payload->data + payload->length);
        return true;
    }

    std::function<uint32_t()> getSerializedSizeProvider(void* data) override
    {
        return [data] { return static_cast<uint32_t>(static_cast<Bytes*>(data)->size()); };
    }

    void* createData() override { return new Bytes; }
    void deleteData(void* data) override { delete static_cast<Bytes*>(data); }
    bool getKey(void*, InstanceHandle_t*, bool) override { return false; }
};

struct Writes : DataWriterListener
{
    explicit Writes(std::string of) : name(std::move(of)) {}
    void on_publication_matched(DataWriter*, const PublicationMatchedStatus& status) override
    {
        say("met " + name + " " + std::to_string(status.current_count));
    }
    std::string name;
};

struct Reads : DataReaderListener
{
    explicit Reads(std::string of) : name(std::move(of)) {}
    void on_subscription_matched(DataReader*, const SubscriptionMatchedStatus& status) override
    {
        say("met " + name + " " + std::to_string(status.current_count));
    }
    void on_data_available(DataReader* reader) override
    {
        Bytes bytes;
        SampleInfo info;
        while (reader->take_next_sample(&bytes, &info) == ReturnCode_t::RETCODE_OK)
            if (info.valid_data)
                say("got " + name + " " + std::to_string(bytes.size()), bytes);
    }
    std::string name;
};

struct Asked
{
    bool reliable, durable;
    int depth;
    double deadline, lease, lifespan;
};

static eprosima::fastrtps::Duration_t span(double milliseconds)
{
    return eprosima::fastrtps::Duration_t(static_cast<long double>(milliseconds / 1000));
}

template<class Qos> static Qos quality(Qos qos, const Asked& asked)
{
    qos.reliability().kind = asked.reliable ? RELIABLE_RELIABILITY_QOS : BEST_EFFORT_RELIABILITY_QOS;
    qos.durability().kind = asked.durable ? TRANSIENT_LOCAL_DURABILITY_QOS : VOLATILE_DURABILITY_QOS;
    qos.history().depth = asked.depth;
    qos.resource_limits().max_samples_per_instance = qos.resource_limits().max_samples = asked.depth;
    qos.resource_limits().allocated_samples = 1;
    qos.endpoint().history_memory_policy = MemoryManagementPolicy_t::DYNAMIC_RESERVE_MEMORY_MODE;
    if (asked.deadline > 0)
        qos.deadline().period = span(asked.deadline);
    if (asked.lease > 0)
    {
        qos.liveliness().lease_duration = span(asked.lease);
        qos.liveliness().announcement_period = span(asked.lease / 3);
    }
    if (asked.lifespan > 0)
        qos.lifespan().duration = span(asked.lifespan);
    return qos;
}

template<class Any> static Any* made(Any* it)
{
    if (!it)
        throw std::runtime_error("Fast DDS makes no such thing");
    return it;
}

class Node
{
public:
    Node()
    {
        auto factory = DomainParticipantFactory::get_instance();
        factory->load_profiles(); // Of the file that FASTRTPS_DEFAULT_PROFILES_FILE names: transports and their buffers.
        participant = made(factory->create_participant(std::atoi(std::getenv("ROS_DOMAIN_ID")), PARTICIPANT_QOS_DEFAULT));
        publisher = made(participant->create_publisher(PUBLISHER_QOS_DEFAULT));
        subscriber = made(participant->create_subscriber(SUBSCRIBER_QOS_DEFAULT));
    }

    ~Node()
    {
        participant->delete_contained_entities();
        DomainParticipantFactory::get_instance()->delete_participant(participant);
    }

    void execute(const std::string& line)
    {
        std::istringstream words(line);
        std::string command, name;
        words >> command >> name;
        if (command == "write")
        {
            size_t size = 0;
            words >> size;
            Bytes bytes(size);
            std::cin.read(bytes.data(), static_cast<std::streamsize>(size));
            if (!writers.at(name)->write(&bytes))
                throw std::runtime_error("no write of " + std::to_string(size) + " bytes");
        }
        else if (command == "delete")
        {
            if (writers.count(name))
                publisher->delete_datawriter(writers.at(name));
            else
                subscriber->delete_datareader(readers.at(name));
            writers.erase(name);
            readers.erase(name);
        }
        else
        {
            std::string topic, type;
            Asked asked{};
            words >> topic >> type >> asked.reliable >> asked.durable >> asked.depth >> asked.deadline >> asked.lease
                >> asked.lifespan;
            if (!words)
                throw std::runtime_error("not understood: " + line);
            add(command == "writer", name, at(topic, type), asked);
        }
    }

private:
    Topic* at(const std::string& name, const std::string& type)
    {
        if (auto topic = participant->lookup_topicdescription(name))
            return static_cast<Topic*>(topic);
        TypeSupport(new Raw(type)).register_type(participant);
        return made(participant->create_topic(name, type, TOPIC_QOS_DEFAULT));
    }

    void add(bool writes, const std::string& name, Topic* topic, const Asked& asked)
    {
        if (!writes)
        {
            auto qos = quality(DATAREADER_QOS_DEFAULT, asked);
            readers[name] = made(subscriber->create_datareader(topic, qos, new Reads(name)));
            return;
        }
        auto qos = quality(DATAWRITER_QOS_DEFAULT, asked);
        qos.publish_mode().kind = ASYNCHRONOUS_PUBLISH_MODE; // Else there are no fragments.
        writers[name] = made(publisher->create_datawriter(topic, qos, new Writes(name)));
    }

    DomainParticipant* participant;
    Publisher* publisher;
    Subscriber* subscriber;
    std::map<std::string, DataWriter*> writers;
    std::map<std::string, DataReader*> readers;
};

int main()
{
    std::ios::sync_with_stdio(false);
    std::cin.tie(nullptr);
    Node node;
    for (std::string line; std::getline(std::cin, line);)
    {
        try
        {
            node.execute(line);
            say("done");
        }
        catch (const std::exception& error)
        {
            say(std::string("failed ") + error.what());
        }
    }
}
