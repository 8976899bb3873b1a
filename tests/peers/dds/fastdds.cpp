// Fast DDS as rmw_fastrtps sets it up, without a type: samples are bytes.
#include <chrono>
#include <condition_variable>
#include <mutex>
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

namespace {

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

int64_t nanoseconds(const rtps::Time_t& time) {
    return int64_t{time.seconds()} * 1000000000 + time.nanosec();
}

class FastWriter : public Writer, fast::DataWriterListener {
public:
    FastWriter(fast::Publisher* publisher, fast::Topic* topic, const Quality& quality) {
        fast::DataWriterQos qos = publisher->get_default_datawriter_qos();
        set(qos, quality);
        qos.publish_mode().kind = fast::ASYNCHRONOUS_PUBLISH_MODE;
        qos.reliability().max_blocking_time = {10, 0};
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

private:
    void on_publication_matched(fast::DataWriter*, const fast::PublicationMatchedStatus& status) override {
        readers_ = status.current_count;
    }
    void on_offered_incompatible_qos(fast::DataWriter*, const fast::OfferedIncompatibleQosStatus& status) override {
        Line().field("incompatible", status.last_policy_id);
    }

    std::atomic<int> readers_ = 0;
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
void secure(fast::DomainParticipantQos& qos, const std::string& folder) {
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

    explicit Service(const Arguments& arguments) {
        const std::string name = arguments.position(1, "a service");
        const std::string type = arguments.position(2, "a type");
        request = dds_topic("rq", name, "Request");
        reply = dds_topic("rr", name, "Reply");
        request_type = dds_type("srv", type, "_Request");
        reply_type = dds_type("srv", type, "_Response");
    }
};

std::string text(const rtps::GUID_t& guid) {
    Body bytes(guid.guidPrefix.value, guid.guidPrefix.value + 12);
    bytes.insert(bytes.end(), guid.entityId.value, guid.entityId.value + 4);
    return hex(bytes);
}

// A service server. It answers with the next of --hex, or with the request itself where there is none.
void serve(const Arguments& arguments) {
    const Service service(arguments);
    const Quality quality;
    std::vector<Body> replies;
    for (const auto& digits : arguments.all("hex")) {
        replies.push_back(of_hex(digits));
    }
    FastParticipant participant(arguments);
    const auto writer = participant.writer(service.reply, service.reply_type, quality);
    auto& replier = static_cast<FastWriter&>(*writer);
    size_t served = 0;
    const auto reader = participant.informed(
        service.request, service.request_type, quality, [&](const Body& request, const fast::SampleInfo& info) {
            // A client of rmw_fastrtps names the reader it awaits the reply with where a reply names the request.
            rtps::SampleIdentity identity = info.sample_identity;
            const auto& awaiting = info.related_sample_identity.writer_guid();
            if (awaiting != rtps::c_Guid_Unknown) {
                identity.writer_guid(awaiting);
            }
            rtps::WriteParams params;
            params.related_sample_identity(identity);
            const Body& reply = replies.empty() ? request : replies[served % replies.size()];
            ++served;
            const bool taken = replier.write(reply, params);
            Line line;
            line.field("request", hex(request)).field("seq", info.sample_identity.sequence_number().to64long());
            line.field("client", text(identity.writer_guid())).field("replied", taken);
        });
    Line().field("ready", arguments.position(1, "a service"));
    Lifetime::wait_until_told();
}

// A service client: one request of --hex after the other, each awaited.
void call(const Arguments& arguments) {
    const Service service(arguments);
    const Quality quality;
    std::mutex heard;
    std::condition_variable came;
    std::map<int64_t, Body> replies;
    std::atomic<uint64_t> of_others = 0;
    FastParticipant participant(arguments);
    const auto writer = participant.writer(service.request, service.request_type, quality);
    auto& requester = static_cast<FastWriter&>(*writer);
    rtps::GUID_t own;
    const auto reader = participant.informed(
        service.reply, service.reply_type, quality, [&](const Body& reply, const fast::SampleInfo& info) {
            const std::lock_guard<std::mutex> guard(heard);
            const auto& identity = info.related_sample_identity;
            if (identity.writer_guid() != own && identity.writer_guid() != requester.guid()) {
                ++of_others;
                return;
            }
            replies[identity.sequence_number().to64long()] = reply;
            came.notify_all();
        });
    {
        const std::lock_guard<std::mutex> guard(heard);
        own = reader->guid();
    }
    Line().field("ready", arguments.position(1, "a service"));
    while (requester.readers() < 1 || reader->writers() < 1) {
        std::this_thread::sleep_for(std::chrono::milliseconds(2));
    }
    Line().field("matched", true);
    const auto& requests = arguments.all("hex");
    const auto count = static_cast<size_t>(arguments.number("count", static_cast<double>(requests.size())));
    const auto patience = std::chrono::duration<double>(arguments.number("patience", 10));
    for (size_t turn = 0; turn < count && !requests.empty() && !Lifetime::told(); ++turn) {
        rtps::WriteParams params;
        params.related_sample_identity().writer_guid() = own;
        const auto start = std::chrono::steady_clock::now();
        if (!requester.write(of_hex(requests[turn % requests.size()]), params)) {
            Line().field("refused", turn);
            continue;
        }
        const int64_t sequence = params.sample_identity().sequence_number().to64long();
        std::unique_lock<std::mutex> guard(heard);
        const bool answered = came.wait_for(guard, patience, [&] { return replies.count(sequence) > 0; });
        const double took = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
        Line line;
        line.field("seq", sequence).field("seconds", took);
        if (answered) {
            line.field("reply", hex(replies[sequence]));
        } else {
            line.put("reply", "null");
        }
    }
    Line().field("done", true).field("of_others", of_others.load());
    Lifetime::wait_until_told();
}

} // namespace

std::unique_ptr<Participant> join(const Arguments& arguments) {
    return std::make_unique<FastParticipant>(arguments);
}

int main(int count, char** words) {
    const Arguments arguments(count, words);
    Lifetime::bound(arguments.number("limit", 120));
    const std::string command = arguments.position(0, "a command: pub, sub, relay, crowd, serve, call");
    if (command == "serve") {
        serve(arguments);
    } else if (command == "call") {
        call(arguments);
    } else if (!run_shared(command, arguments)) {
        Arguments::fail("there is no command " + command);
    }
    return 0;
}
