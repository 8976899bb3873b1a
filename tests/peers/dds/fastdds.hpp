// Fast DDS as rmw_fastrtps sets it up, without a type: samples are bytes.
#pragma once

#include <chrono>
#include <condition_variable>
#include <mutex>
#include <set>
#include <thread>

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
#include <fastdds/dds/topic/TypeSupport.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>

#include "domain.hpp"
#include "lines.hpp"

namespace fast = eprosima::fastdds::dds;
namespace rtps = eprosima::fastrtps::rtps;
using eprosima::fastrtps::types::ReturnCode_t;

// A type of any name whose samples are Body.
class Opaque : public fast::TopicDataType {
public:
    explicit Opaque(const std::string& name) {
        setName(name.c_str());
        // What is allocated before the first sample; more is when it comes.
        m_typeSize = 4 + 256;
        m_isGetKeyDefined = false;
        auto_fill_type_object(false);
        auto_fill_type_information(false);
    }

    bool serialize(void* data, rtps::SerializedPayload_t* payload) override {
        const Body& body = *static_cast<Body*>(data);
        const uint8_t header[4] = {0, 1, 0, 0};
        if (payload->max_size < sizeof header + body.size()) {
            return false;
        }
        payload->encapsulation = CDR_LE;
        payload->length = static_cast<uint32_t>(sizeof header + body.size());
        std::memcpy(payload->data, header, sizeof header);
        std::memcpy(payload->data + sizeof header, body.data(), body.size());
        return true;
    }

    bool deserialize(rtps::SerializedPayload_t* payload, void* data) override {
        if (payload->length < 4) {
            return false;
        }
        static_cast<Body*>(data)->assign(payload->data + 4, payload->data + payload->length);
        return true;
    }

    std::function<uint32_t()> getSerializedSizeProvider(void* data) override {
        return [data] { return static_cast<uint32_t>(4 + static_cast<Body*>(data)->size()); };
    }

    void* createData() override { return new Body; }
    void deleteData(void* data) override { delete static_cast<Body*>(data); }
    bool getKey(void*, rtps::InstanceHandle_t*, bool) override { return false; }
};

template <typename Qos> void set(Qos& qos, const Quality& quality) {
    qos.reliability().kind = quality.reliable ? fast::RELIABLE_RELIABILITY_QOS : fast::BEST_EFFORT_RELIABILITY_QOS;
    qos.durability().kind = quality.transient_local ? fast::TRANSIENT_LOCAL_DURABILITY_QOS : fast::VOLATILE_DURABILITY_QOS;
    qos.history().kind = fast::KEEP_LAST_HISTORY_QOS;
    qos.history().depth = quality.depth;
    qos.resource_limits().max_samples = 0;
    qos.resource_limits().max_instances = 0;
    qos.resource_limits().max_samples_per_instance = 0;
    qos.endpoint().history_memory_policy = rtps::PREALLOCATED_WITH_REALLOC_MEMORY_MODE;
    qos.data_sharing().off();
}

template <typename Made> Made* made(Made* entity, const char* what) {
    if (entity == nullptr) {
        std::fprintf(stderr, "peer: Fast DDS makes no %s\n", what);
        std::_Exit(1);
    }
    return entity;
}

inline int64_t nanoseconds(const rtps::Time_t& time) {
    return int64_t{time.seconds()} * 1000000000 + time.nanosec();
}

class FastWriter : public Writer, fast::DataWriterListener {
public:
    FastWriter(fast::Publisher* publisher, fast::Topic* topic, const Quality& quality) {
        fast::DataWriterQos qos = publisher->get_default_datawriter_qos();
        set(qos, quality);
        qos.publish_mode().kind = fast::ASYNCHRONOUS_PUBLISH_MODE;
        qos.reliability().max_blocking_time = {10, 0};
        if (quality.heartbeat_period) {
            qos.reliable_writer_qos().times.heartbeatPeriod = {*quality.heartbeat_period, 0};
        }
        writer_ = made(publisher->create_datawriter(topic, qos, this), "writer");
    }

    bool write(const Body& body) override { return writer_->write(const_cast<Body*>(&body)); }
    bool write(const Body& body, rtps::WriteParams& params) { return writer_->write(const_cast<Body*>(&body), params); }
    int readers() override { return readers_; }
    rtps::GUID_t guid() const { return writer_->guid(); }
    bool acknowledged(double seconds) override {
        const auto whole = static_cast<int32_t>(seconds);
        return writer_->wait_for_acknowledgments({whole, 0}) == ReturnCode_t::RETCODE_OK;
    }

    // Answers a client, as rmw_fastrtps does it: its request may come before the reader is known that awaits the reply, and
    // a reply that goes out before that reader is matched is lost. Who names no reader is answered at once.
    bool reply(const rtps::SampleIdentity& to, const Body& body) {
        const auto& reader = to.writer_guid();
        if (reader.entityId.is_reader()) {
            std::unique_lock<std::mutex> guard(lock_);
            matched_.wait_for(guard, std::chrono::seconds(2), [&] { return guids_.count(reader) > 0; });
        }
        rtps::WriteParams params;
        params.related_sample_identity(to);
        return write(body, params);
    }

private:
    void on_publication_matched(fast::DataWriter*, const fast::PublicationMatchedStatus& status) override {
        readers_ = status.current_count;
        const std::lock_guard<std::mutex> guard(lock_);
        const auto reader = rtps::iHandle2GUID(status.last_subscription_handle);
        if (status.current_count_change > 0) {
            guids_.insert(reader);
        } else {
            guids_.erase(reader);
        }
        matched_.notify_all();
    }
    void on_offered_incompatible_qos(fast::DataWriter*, const fast::OfferedIncompatibleQosStatus& status) override {
        Line().field("incompatible", status.last_policy_id);
    }

    std::atomic<int> readers_ = 0;
    std::mutex lock_;
    std::condition_variable matched_;
    std::set<rtps::GUID_t> guids_;
    fast::DataWriter* writer_;
};

using Heard = std::function<void(const Body&, const fast::SampleInfo&)>;

class FastReader : public Reader, fast::DataReaderListener {
public:
    FastReader(fast::Subscriber* subscriber, fast::Topic* topic, const Quality& quality, Heard heard)
        : heard_(std::move(heard)) {
        fast::DataReaderQos qos = subscriber->get_default_datareader_qos();
        set(qos, quality);
        reader_ = made(subscriber->create_datareader(topic, qos, this), "reader");
    }
    ~FastReader() override { reader_->set_listener(nullptr); }

    int writers() override { return writers_; }
    rtps::GUID_t guid() const { return reader_->guid(); }

private:
    void on_data_available(fast::DataReader* reader) override {
        fast::SampleInfo info;
        while (reader->take_next_sample(&body_, &info) == ReturnCode_t::RETCODE_OK) {
            if (info.valid_data) {
                heard_(body_, info);
            }
        }
    }
    void on_subscription_matched(fast::DataReader*, const fast::SubscriptionMatchedStatus& status) override {
        writers_ = status.current_count;
    }
    void on_requested_incompatible_qos(fast::DataReader*, const fast::RequestedIncompatibleQosStatus& status) override {
        Line().field("incompatible", status.last_policy_id);
    }

    Heard heard_;
    Body body_;
    std::atomic<int> writers_ = 0;
    fast::DataReader* reader_;
};

// As rmw_fastrtps does with the enclave of a node.
inline void secure(fast::DomainParticipantQos& qos, const std::string& folder) {
    const std::string auth = "dds.sec.auth.builtin.PKI-DH.";
    const std::string access = "dds.sec.access.builtin.Access-Permissions.";
    const std::pair<std::string, std::string> properties[] = {
        {"dds.sec.auth.plugin", "builtin.PKI-DH"},
        {auth + "identity_ca", "file://" + folder + "/identity_ca.cert.pem"},
        {auth + "identity_certificate", "file://" + folder + "/cert.pem"},
        {auth + "private_key", "file://" + folder + "/key.pem"},
        {"dds.sec.crypto.plugin", "builtin.AES-GCM-GMAC"},
        {"dds.sec.access.plugin", "builtin.Access-Permissions"},
        {access + "permissions_ca", "file://" + folder + "/permissions_ca.cert.pem"},
        {access + "governance", "file://" + folder + "/governance.p7s"},
        {access + "permissions", "file://" + folder + "/permissions.p7s"},
    };
    for (const auto& [name, value] : properties) {
        qos.properties().properties().emplace_back(name, value);
    }
}

class FastParticipant : public Participant {
public:
    explicit FastParticipant(const Arguments& arguments) {
        fast::DomainParticipantQos qos;
        qos.name("/");
        const std::string enclave = "enclave=/;";
        qos.user_data().assign(enclave.begin(), enclave.end());
        const auto udp = std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>();
        for (const auto& address : arguments.all("interface")) {
            udp->interfaceWhiteList.push_back(address);
        }
        qos.transport().use_builtin_transports = false;
        qos.transport().user_transports.push_back(udp);
        if (const std::string enclave_folder = arguments.text("enclave", ""); !enclave_folder.empty()) {
            secure(qos, enclave_folder);
        }
        const auto domain = static_cast<uint32_t>(arguments.number("domain", 0));
        participant_
            = made(fast::DomainParticipantFactory::get_instance()->create_participant(domain, qos), "participant");
        publisher_ = made(participant_->create_publisher(fast::PUBLISHER_QOS_DEFAULT), "publisher");
        subscriber_ = made(participant_->create_subscriber(fast::SUBSCRIBER_QOS_DEFAULT), "subscriber");
    }
    ~FastParticipant() override {
        participant_->delete_contained_entities();
        fast::DomainParticipantFactory::get_instance()->delete_participant(participant_);
    }

    std::unique_ptr<Writer> writer(const std::string& topic, const std::string& type, const Quality& quality) override {
        return std::make_unique<FastWriter>(publisher_, make_topic(topic, type), quality);
    }
    std::unique_ptr<Reader> reader(const std::string& topic, const std::string& type, const Quality& quality,
        std::function<void(const Sample&)> heard) override {
        return informed(topic, type, quality, [heard](const Body& body, const fast::SampleInfo& info) {
            heard(Sample{body, nanoseconds(info.source_timestamp)});
        });
    }
    std::unique_ptr<FastReader> informed(
        const std::string& topic, const std::string& type, const Quality& quality, Heard heard) {
        return std::make_unique<FastReader>(subscriber_, make_topic(topic, type), quality, std::move(heard));
    }

private:
    fast::Topic* make_topic(const std::string& name, const std::string& type) {
        if (auto* there = dynamic_cast<fast::Topic*>(participant_->lookup_topicdescription(name))) {
            return there;
        }
        fast::TypeSupport(new Opaque(type)).register_type(participant_);
        return made(participant_->create_topic(name, type, fast::TOPIC_QOS_DEFAULT), "topic");
    }

    fast::DomainParticipant* participant_;
    fast::Publisher* publisher_;
    fast::Subscriber* subscriber_;
};

// The topics and types of a service.
struct Service {
    std::string request, reply, request_type, reply_type;

    // `kind` is srv, or action for the services of an action.
    Service(const std::string& name, const std::string& kind, const std::string& type)
        : request(dds_topic("rq", name, "Request"))
        , reply(dds_topic("rr", name, "Reply"))
        , request_type(dds_type(kind, type, "_Request"))
        , reply_type(dds_type(kind, type, "_Response")) { }
};

// The client of a request as a reply names it: one of rmw_fastrtps gives the reader it awaits the reply with.
inline rtps::SampleIdentity client_of(const fast::SampleInfo& info) {
    rtps::SampleIdentity identity = info.sample_identity;
    const auto& awaiting = info.related_sample_identity.writer_guid();
    if (awaiting != rtps::c_Guid_Unknown) {
        identity.writer_guid(awaiting);
    }
    return identity;
}
