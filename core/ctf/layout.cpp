#include "ctf/layout.hpp"

#include <algorithm>
#include <array>
#include <bit>
#include <limits>
#include <map>
#include <stdexcept>
#include <string>
#include <string_view>
#include <utility>

namespace chainshaper::ctf {
namespace {

constexpr std::size_t deepest = 12;
// Types to lay out in all: a trace with all the kernel's events has some 10,000.
constexpr std::size_t most_types = 200'000;
constexpr std::int64_t dense_ids = 4096;
// What a packet costs in addition to its steps: about as many bytes as are stored about it.
constexpr std::int64_t packet_row_cost = 120;

// The fields of packet header and context, and of an event's header, that the decoder itself needs.
constexpr std::array<std::pair<std::string_view, Variable>, well_known_variables> well_known{{
    {"id", event_id},
    {"magic", magic},
    {"stream_id", stream_id},
    {"stream_instance_id", stream_instance_id},
    {"timestamp_begin", timestamp_begin},
    {"timestamp_end", timestamp_end},
    {"packet_seq_num", packet_seq_num},
    {"events_discarded", events_discarded},
    {"cpu_id", cpu_id},
    {"content_size", content_size},
    {"packet_size", packet_size},
    {"uuid_low", uuid_low},
    {"uuid_high", uuid_high},
}};

std::int64_t sum(std::int64_t first, std::int64_t second) {
  return std::min(first + second, endless_bits);
}

std::int64_t product(std::int64_t first, std::int64_t second) {
  std::int64_t result = 0;
  return __builtin_mul_overflow(first, second, &result) ? endless_bits
                                                        : std::min(result, endless_bits);
}

std::int64_t aligned(std::int64_t position, std::int64_t align) {
  return (position + align - 1) & -align;
}

template <typename Is>
const Is * as(const Type & type) {
  return std::get_if<Is>(&type->is);
}

bool is_byte(const Type & type) {
  const auto * integer = as<Integer>(type);
  return integer != nullptr && integer->size == 8 && integer->align == 8;
}

// Names

// An integer that lengths and tags can refer to.
struct Number {
  std::int32_t variable;
  const Integer * integer;
};

// The names of numbers in a structure or a variant. Structures and variants that are its members
// have frames of their own.
struct Frame {
  std::map<std::string, Number, std::less<>> numbers;
  std::map<std::string, std::shared_ptr<Frame>, std::less<>> frames;

  // Declares a number; of a name that is declared again, the later declaration counts.
  void declare(const std::string & name, Number number) {
    frames.erase(name);
    numbers[name] = number;
  }

  // Declares a member that has names in it; returns its frame.
  std::shared_ptr<Frame> enter(const std::string & name) {
    numbers.erase(name);
    return frames[name] = std::make_shared<Frame>();
  }

  // Returns the number at the end of a path `a.b.c`; nullptr: there is none.
  const Number * find(std::string_view path) const {
    const Frame * frame = this;
    for (auto dot = path.find('.'); dot != path.npos; dot = path.find('.')) {
      const auto inner = frame->frames.find(path.substr(0, dot));
      if (inner == frame->frames.end()) return nullptr;
      frame = inner->second.get();
      path.remove_prefix(dot + 1);
    }
    const auto number = frame->numbers.find(path);
    return number == frame->numbers.end() ? nullptr : &number->second;
  }
};

// Where a type stands: the names around it, and the column that its value goes to.
struct Place {
  std::vector<std::shared_ptr<Frame>> frames;
  std::int32_t column{none};

  // The place of members of a structure, variant or array, which get no columns.
  Place inside(std::shared_ptr<Frame> frame) const {
    Place place{frames, none};
    place.frames.push_back(std::move(frame));
    return place;
  }
};

// Steps

// Writes the steps of scopes, one after the other.
class Writer {
public:
  Writer(Layout & layout, const TraceClass & trace) : layout_(&layout), trace_(&trace) {}

  // Returns a writer that knows the names that were declared so far: for one of several scopes that
  // may follow.
  Writer following(bool in_headers) const {
    Writer writer = *this;
    writer.in_headers_ = in_headers;
    return writer;
  }

  // Begins a list of steps.
  void begin() { start_ = steps().size(); }

  // Returns the list of steps that were written since it began.
  Steps written() const { return {start_, layout_->steps.size()}; }

  // Lays out a scope in a list of its own.
  Steps write(const std::string & scope, const std::optional<Structure> & structure) {
    begin();
    append(scope, structure, {});
    return written();
  }

  // Lays out a scope at the end of the list. `columns`: number of a field → its column, if any.
  void append(const std::string & scope, const std::optional<Structure> & structure,
              const std::map<std::size_t, std::int32_t> & columns) {
    const auto frame = root(scope);
    if (structure) {
      skip(structure->align, 0);
      for (std::size_t index = 0; index < structure->fields.size(); ++index) {
        const auto column = columns.find(index);
        member(structure->fields[index],
               Place{{frame}, column == columns.end() ? none : column->second});
      }
    }
    layout_->variables = std::max(layout_->variables, variables_);
  }

  // Returns which variables packet header and packet context have: bit n stands for Variable n.
  std::uint32_t known() const {
    std::uint32_t known = 0;
    for (const auto & [scope, frame] : roots_)
      if (scope == "trace.packet.header" || scope == "stream.packet.context")
        for (const auto & [name, number] : frame->numbers)
          if (number.variable >= 0 && number.variable < well_known_variables)
            known |= std::uint32_t{1} << number.variable;
    return known;
  }

private:
  std::vector<Step> & steps() { return layout_->steps; }

  // Begins the frame of a dynamic scope, in place of a frame that it has already.
  std::shared_ptr<Frame> root(const std::string & scope) {
    auto frame = std::make_shared<Frame>();
    for (auto & [name, known_frame] : roots_)
      if (name == scope) {
        known_frame = frame;
        return frame;
      }
    roots_.emplace_back(scope, frame);
    return frame;
  }

  // Lays out a field of a scope; the trace's UUID as two numbers of 64 bits.
  void member(const Field & field, const Place & place) {
    const auto * array = as<Array>(field.type);
    const auto * length = array == nullptr ? nullptr : std::get_if<std::int64_t>(&array->length);
    if (in_headers_ && field.name == "uuid" && length != nullptr && *length == 16 &&
        is_byte(array->element)) {
      static const Integer half{64, 8, false, false, false, {}};
      number("uuid_low", half, place);
      number("uuid_high", half, place);
    } else {
      lay_out(field.name, field.type, place);
    }
  }

  // Lays out a type; returns the fewest bits that its values take, alignment aside.
  std::int64_t lay_out(const std::string & name, const Type & type, const Place & place) {
    count_types(1, name);
    if (place.frames.size() > deepest) too_deep(name);
    if (const auto * integer = as<Integer>(type)) return number(name, *integer, place);
    if (const auto * array = as<Array>(type)) return array_of(name, type, *array, place);
    if (const auto * variant = as<Variant>(type)) return choice(name, *variant, place);
    if (const auto * structure = as<Structure>(type)) {
      const auto inner = place.inside(place.frames.back()->enter(name));
      skip(structure->align, 0);
      std::int64_t least = 0;
      for (const Field & field : structure->fields)
        least = sum(least, lay_out(field.name, field.type, inner));
      return least;
    }
    add({.does = Step::Does::text, .is_text = true, .column = place.column, .align = 8});
    return 8;
  }

  void count_types(std::size_t count, const std::string & name) {
    layout_->types += count;
    if (layout_->types > most_types) too_deep(name);
  }

  [[noreturn]] static void too_deep(const std::string & name) {
    throw std::invalid_argument(name + ": types nested too deeply");
  }

  std::int64_t number(const std::string & name, const Integer & integer, const Place & place) {
    std::int32_t variable = none;
    bool sets_clock = integer.maps_clock;
    if (const auto fixed = well_known_variable(name, place); fixed != none) {
      variable = fixed;
      // The events of a packet happen before its end, so that must not set the clock.
      sets_clock = sets_clock && variable != timestamp_end;
    } else if (trace_->referenced.contains(name)) {
      variable = variables_++;
    }
    place.frames.back()->declare(name, {variable, &integer});
    if (place.column == none && variable == none && !sets_clock) {
      skip(integer.align, integer.size);
      return integer.size;
    }
    // Whether its bytes in a packet are those in its column.
    const bool same_bytes = integer.align >= 8 && integer.size >= 8 &&
                            std::has_single_bit(static_cast<std::uint64_t>(integer.size)) &&
                            (integer.size == 8 || !integer.big_endian);
    const bool is_moved = same_bytes && !sets_clock && variable == none;
    add({.does = is_moved ? Step::Does::move : Step::Does::number,
         .is_signed = integer.is_signed,
         .big_endian = integer.big_endian,
         .sets_clock = sets_clock,
         .variable = variable,
         .column = place.column,
         .align = integer.align,
         .size = integer.size});
    return integer.size;
  }

  std::int32_t well_known_variable(const std::string & name, const Place & place) const {
    if (!in_headers_ || (place.frames.size() > 1 && name != "id")) return none;
    for (const auto & [known_name, variable] : well_known)
      if (name == known_name) return variable;
    return none;
  }

  std::int64_t array_of(const std::string & name, const Type & type, const Array & array,
                        const Place & place) {
    Step step{.does = Step::Does::loop, .align = alignment(type)};
    if (const auto * path = std::get_if<std::string>(&array.length))
      step.variable = referred(*path, place).variable;
    else
      step.count = std::get<std::int64_t>(array.length);
    if (place.column != none) {
      step.does = Step::Does::characters;
      step.is_text = array.is_text;
      step.column = place.column;
      add(step);
      return product(8, step.count);
    }
    const auto loop = add(step), first = steps().size();
    const auto least = lay_out(name + "[]", array.element, place.inside(std::make_shared<Frame>()));
    close_loop(loop, first, least);
    return product(step.count, least);
  }

  // Ends a loop whose element has the steps from `first` on. Where an element is just skipped, the
  // loop becomes a single step that skips all elements.
  void close_loop(std::size_t loop, std::size_t first, std::int64_t least) {
    const bool single = steps().size() == first + 1;
    const Step element = single ? steps()[first] : steps()[loop];
    // Elements stand without gaps only if their size is a multiple of their alignment.
    const bool is_skipped = element.does == Step::Does::skip && element.size % element.align == 0;
    if (is_skipped && (steps()[loop].variable == none || element.size == 0)) {
      const auto count = steps()[loop].count, align = steps()[loop].align;
      steps().resize(loop);
      skip(std::max(align, element.align), product(element.size, count));
    } else if (is_skipped) {
      steps().resize(first);
      steps()[loop].does = Step::Does::skip_many;
      steps()[loop].size = element.size;
    } else {
      add({.does = Step::Does::again, .target = first});
      steps()[loop].target = steps().size();
      steps()[loop].least = least;
      steps()[loop].cost = cost({first, steps().size()});
    }
  }

public:
  // Returns what it costs at most to run steps once, without the turns of their loops.
  std::int64_t cost(Steps run) const {
    std::size_t cost = run.end - run.first;
    for (auto index = run.first; index < run.end; ++index)
      if (layout_->steps[index].does == Step::Does::choose) cost += layout_->steps[index].ranges;
    return static_cast<std::int64_t>(cost);
  }

private:
  std::int64_t choice(const std::string & name, const Variant & variant, const Place & place) {
    if (!variant.tag) throw std::invalid_argument("variant '" + name + "' has no tag");
    const Number tag = referred(*variant.tag, place);
    auto & ranges = layout_->ranges;
    const auto first = ranges.size();
    for (std::size_t option = 0; option < variant.options.size(); ++option)
      add_ranges(*tag.integer, variant.options[option].name, option);
    count_types(ranges.size() - first, name);
    add({.does = Step::Does::choose,
         .is_signed = tag.integer->is_signed,
         .variable = tag.variable,
         .first_range = first,
         .ranges = ranges.size() - first});
    const auto inner = place.inside(place.frames.back()->enter(name));
    std::vector<std::size_t> begins, jumps;
    auto least = variant.options.empty() ? 0 : endless_bits;
    const auto last = ranges.size();
    for (const Field & option : variant.options) {
      begins.push_back(steps().size());
      least = std::min(least, lay_out(option.name, option.type, inner));
      jumps.push_back(add({.does = Step::Does::jump}));
    }
    for (const auto jump : jumps) steps()[jump].target = steps().size();
    // Until here the target of a range was the number of its option.
    for (auto range = first; range < last; ++range)
      ranges[range].target = begins[ranges[range].target];
    return least;
  }

  // Adds the tags that choose the option of this number. LTTng writes an option's name with or
  // without a leading underscore.
  void add_ranges(const Integer & tag, const std::string & option, std::size_t number) {
    for (const bool bare : {false, true}) {
      if (bare && (option.empty() || option[0] != '_')) continue;
      const auto labelled = tag.labels.find(bare ? option.substr(1) : option);
      if (labelled == tag.labels.end()) continue;
      for (const Range & range : labelled->second)
        layout_->ranges.push_back({range.low, range.high, number});
    }
  }

  // Returns the number that the path of a length or tag names (7.3.2): an absolute path begins with
  // a scope; a relative one is searched from the innermost frame outwards, then in the scopes, the
  // latest one first.
  Number referred(const std::string & path, const Place & place) const {
    const std::string_view names = path;
    for (const auto & [scope, frame] : roots_)
      if (names.size() > scope.size() && names.starts_with(scope) && names[scope.size()] == '.')
        if (const auto * number = frame->find(names.substr(scope.size() + 1))) return *number;
    for (auto frame = place.frames.rbegin(); frame != place.frames.rend(); ++frame)
      if (const auto * number = (*frame)->find(names)) return *number;
    for (auto root = roots_.rbegin(); root != roots_.rend(); ++root)
      if (const auto * number = root->second->find(names)) return *number;
    throw std::invalid_argument("length or tag '" + path +
                                "' names no number that is read before it");
  }

  // Appends a step; returns its number.
  std::size_t add(const Step & step) {
    steps().push_back(step);
    return steps().size() - 1;
  }

  // Appends a skip, or makes the skip before longer where that comes to the same.
  void skip(std::int64_t align, std::int64_t size) {
    size = std::min(size, endless_bits);
    if (steps().size() > start_) {
      Step & last = steps().back();
      if (last.does == Step::Does::skip &&
          (last.size == 0 || (align <= last.align && last.size % align == 0))) {
        last.align = std::max(last.align, align);
        last.size = sum(last.size, size);
        return;
      }
    }
    add({.does = Step::Does::skip, .align = align, .size = size});
  }

  Layout * layout_;
  const TraceClass * trace_;
  bool in_headers_{true};
  std::int32_t variables_{well_known_variables};
  std::size_t start_{0};
  std::vector<std::pair<std::string, std::shared_ptr<Frame>>> roots_;  // by dynamic scope
};

// Event and stream classes

// Finds out whether an event is of constant layout; and if bytes only have to be moved to its
// columns, which ones.
void note_constant_layout(const Layout & layout, EventLayout & event) {
  std::int64_t align = 1, position = 0;
  bool moves_only = true;
  std::vector<Move> moves;
  for (auto index = event.steps.first; index < event.steps.end; ++index) {
    const Step & step = layout.steps[index];
    if (position == 0) align = std::max(align, step.align);
    const bool is_number = step.does == Step::Does::number && !step.sets_clock;
    const bool constant = is_number || step.does == Step::Does::skip ||
                          step.does == Step::Does::move || step.does == Step::Does::characters;
    if (!constant || step.variable != none || step.align > align) return;
    moves_only = moves_only && !is_number;
    position = sum(position, -position & (step.align - 1));
    const bool is_characters = step.does == Step::Does::characters;
    const auto size = is_characters ? product(8, step.count) : step.size;
    if (step.column != none)
      moves.push_back({position >> 3, size >> 3, step.column, is_characters, step.is_text});
    position = sum(position, size);
  }
  event.align = align;
  event.size = position;
  event.is_moved = align >= 8 && position > 0 && moves_only;
  if (event.is_moved) event.moves = std::move(moves);
}

// Returns the form of a header that LTTng writes; `align` 0: it is another, which its steps read.
QuickHeader quick_header(const std::optional<Structure> & header, bool big_endian) {
  if (!header || header->fields.size() != 2 || header->fields[0].name != "id" || big_endian)
    return {};
  const auto * id = as<Integer>(header->fields[0].type);
  const auto * variant = as<Variant>(header->fields[1].type);
  if (id == nullptr || variant == nullptr || id->is_signed || id->big_endian || id->size > 62 ||
      variant->tag != "id" || variant->options.empty() || variant->options[0].name != "compact")
    return {};
  const auto * compact = as<Structure>(variant->options[0].type);
  if (compact == nullptr || compact->fields.size() != 1) return {};
  const auto * clock = as<Integer>(compact->fields[0].type);
  if (clock == nullptr || !clock->maps_clock || clock->is_signed || clock->big_endian) return {};
  const auto last = (std::uint64_t{1} << id->size) - 1;
  const auto has = [&](const char * label, std::uint64_t low, std::uint64_t high) {
    const auto labelled = id->labels.find(label);
    return labelled != id->labels.end() && labelled->second.size() == 1 &&
           labelled->second[0].low == low && labelled->second[0].high == high;
  };
  if (id->labels.size() != 2 || !has("compact", 0, last - 1) || !has("extended", last, last))
    return {};
  const auto shift = aligned(id->size, compact->align);
  if (clock->size > 63 || shift + clock->size > 64) return {};
  if (header->align < std::max<std::int64_t>(8, compact->align)) return {};
  return {header->align, id->size, shift, clock->size};
}

// Returns where LTTng's context has the process and the thread; zeros: they are not both of 32 bits
// and at constant places.
ProcessPlace process_place(const StreamClass & stream) {
  if (!stream.event_context) return {};
  std::int64_t position = 0, process = none, thread = none;
  for (const auto & [name, type] : stream.event_context->fields) {
    position = aligned(position, alignment(type));
    if (const auto * integer = as<Integer>(type)) {
      if (integer->size == 32 && integer->align >= 8) {
        if (name == "vpid" || name == "_vpid") process = position;
        if (name == "vtid" || name == "_vtid") thread = position;
      }
      position = sum(position, integer->size);
      continue;
    }
    const auto * array = as<Array>(type);
    const auto * length = array == nullptr ? nullptr : std::get_if<std::int64_t>(&array->length);
    const auto * element = array == nullptr ? nullptr : as<Integer>(array->element);
    if (length == nullptr || element == nullptr || element->size % element->align != 0) break;
    position = sum(position, product(element->size, *length));
  }
  if (process == none || thread == none) return {};
  return {stream.event_context->align, process, thread};
}

// Returns the structure of a scope of an event; none: it has no such scope.
const std::optional<Structure> & structure_of(const StreamClass & stream, const EventClass & event,
                                              Scope scope) {
  if (scope == Scope::stream_event_context) return stream.event_context;
  return scope == Scope::event_context ? event.context : event.fields;
}

// Returns number of a field → its column, for the fields of a scope; sets the widths of the
// columns.
std::map<std::size_t, std::int32_t> columns_of(const WantedEvent & wanted, Scope scope,
                                               const std::optional<Structure> & structure,
                                               std::vector<std::int64_t> & widths) {
  std::map<std::size_t, std::int32_t> columns;
  for (std::size_t column = 0; column < wanted.columns.size(); ++column) {
    const auto [scope_of_column, field] = wanted.columns[column];
    if (scope_of_column != scope) continue;
    if (!structure || field >= structure->fields.size())
      throw std::invalid_argument("a column of a field that is not declared");
    const auto width = column_width(*structure->fields[field].type);
    if (!width || columns.contains(field))
      throw std::invalid_argument("field '" + structure->fields[field].name +
                                  "' cannot have a column, or not two");
    columns[field] = static_cast<std::int32_t>(column);
    widths.at(column) = *width;
  }
  return columns;
}

// Sets the table that an event goes to; all events of a table must have the same columns.
void join_table(Layout & layout, EventLayout & event, const WantedEvent & wanted,
                TableLayout table) {
  const auto number = static_cast<std::size_t>(wanted.table);
  if (wanted.table < 0 || number > layout.tables.size())
    throw std::invalid_argument("tables are counted in order of their first event");
  for (const auto width : table.widths) event.cost += width;
  event.cost += 8 + (table.has_cpu ? 4 : 0);  // the time and the core
  event.table = wanted.table;
  if (number == layout.tables.size()) {
    layout.tables.push_back(std::move(table));
  } else if (layout.tables[number].widths != table.widths ||
             layout.tables[number].has_cpu != table.has_cpu) {
    throw std::invalid_argument("events of one table have different columns");
  }
}

void add_event(Layout & layout, Writer writer, const StreamClass & stream, bool has_cpu,
               std::int64_t header_cost, const EventClass & declared, const WantedEvent * wanted) {
  EventLayout event;
  std::vector<std::int64_t> widths(wanted == nullptr ? 0 : wanted->columns.size());
  writer.begin();
  for (const auto & [scope, name] : {std::pair{Scope::stream_event_context, "stream.event.context"},
                                     std::pair{Scope::event_context, "event.context"},
                                     std::pair{Scope::event_fields, "event.fields"}}) {
    const auto & structure = structure_of(stream, declared, scope);
    std::map<std::size_t, std::int32_t> columns;
    if (wanted != nullptr) columns = columns_of(*wanted, scope, structure, widths);
    writer.append(name, structure, columns);
  }
  event.steps = writer.written();
  event.cost = writer.cost(event.steps) + header_cost;
  if (wanted != nullptr) join_table(layout, event, *wanted, {has_cpu, std::move(widths)});
  note_constant_layout(layout, event);
  layout.events.push_back(std::move(event));
}

// Sets the event class of each id: of small ids in a vector, of others in a sorted list.
void note_ids(StreamLayout & stream_layout,
              std::vector<std::pair<std::int64_t, std::int32_t>> ids) {
  if (ids.size() == 1) stream_layout.default_event = ids[0].first;
  std::sort(ids.begin(), ids.end());
  for (const auto & [id, event] : ids) {
    if (id >= 0 && id < dense_ids) {
      stream_layout.events.resize(static_cast<std::size_t>(id) + 1, none);
      stream_layout.events.back() = event;
    } else {
      stream_layout.rare_events.emplace_back(id, event);
    }
  }
}

// An event's span is known if its layout is constant, and its start is aligned wherever the
// header's is.
void note_spans(const Layout & layout, StreamLayout & stream_layout) {
  if (stream_layout.quick.align == 0) return;
  for (const auto number : stream_layout.events) {
    QuickEvent quick{number, 0};
    if (number != none) {
      const EventLayout & event = layout.events[static_cast<std::size_t>(number)];
      if (event.align != 0 && stream_layout.quick.align % event.align == 0) {
        const auto behind = stream_layout.quick.clock_shift + stream_layout.quick.clock_bits;
        const auto span = ((behind + event.align - 1) & -event.align) + event.size;
        if (span <= std::numeric_limits<std::int32_t>::max())
          quick.span = static_cast<std::int32_t>(span);
      }
    }
    stream_layout.quick_events.push_back(quick);
  }
}

void add_stream(Layout & layout, const TraceClass & trace, const StreamClass & stream,
                Writer header, Steps in_header, std::span<const WantedEvent> & wanted) {
  StreamLayout stream_layout{};
  stream_layout.id = stream.id;
  stream_layout.packet_header = in_header;
  stream_layout.packet_context = header.write("stream.packet.context", stream.packet_context);
  stream_layout.event_header = header.write("stream.event.header", stream.event_header);
  stream_layout.quick = quick_header(stream.event_header, trace.big_endian);
  if (!trace.of_kernel) stream_layout.process = process_place(stream);
  stream_layout.frequency_hz = stream.frequency_hz;
  stream_layout.packet_cost =
      packet_row_cost + header.cost(in_header) + header.cost(stream_layout.packet_context);
  stream_layout.known = header.known();
  if (trace.uuid)
    stream_layout.uuid = *trace.uuid;
  else
    stream_layout.known &= ~(std::uint32_t{1} << uuid_low);
  if (stream_layout.frequency_hz <= 0) throw std::invalid_argument("a clock without a frequency");

  const auto header_cost = header.cost(stream_layout.event_header);
  std::vector<std::pair<std::int64_t, std::int32_t>> ids;
  for (const EventClass & event : stream.events) {
    const auto number = layout.events.size();
    ids.emplace_back(event.id, static_cast<std::int32_t>(number));
    const WantedEvent * wish = nullptr;
    if (!wanted.empty() && wanted.front().event == number) {
      wish = &wanted.front();
      wanted = wanted.subspan(1);
    }
    add_event(layout, header.following(false), stream, stream_layout.knows(cpu_id), header_cost,
              event, wish);
  }
  note_ids(stream_layout, std::move(ids));
  note_spans(layout, stream_layout);
  layout.streams.push_back(std::move(stream_layout));
}

void add_trace(Layout & layout, const TraceClass & trace, std::span<const WantedEvent> & wanted) {
  const auto first = layout.streams.size();
  Writer header(layout, trace);
  const auto in_header = header.write("trace.packet.header", trace.packet_header);
  for (const StreamClass & stream : trace.streams)
    add_stream(layout, trace, stream, header.following(true), in_header, wanted);
  layout.traces.emplace_back(first, layout.streams.size());
}

}  // namespace

std::int32_t StreamLayout::rare_event(std::int64_t id_of_event) const {
  const auto place =
      std::lower_bound(rare_events.begin(), rare_events.end(), id_of_event,
                       [](const auto & pair, auto sought) { return pair.first < sought; });
  return place != rare_events.end() && place->first == id_of_event ? place->second : none;
}

std::optional<std::int64_t> column_width(const Kind & kind) {
  if (const auto * integer = std::get_if<Integer>(&kind.is))
    return static_cast<std::int64_t>(
        std::bit_ceil(static_cast<std::uint64_t>(integer->size + 7) / 8));
  const auto * array = std::get_if<Array>(&kind.is);
  const bool bytes = array != nullptr && is_byte(array->element);
  if (bytes || std::holds_alternative<String>(kind.is)) return 4;
  return std::nullopt;
}

Layout lay_out(std::span<const TraceClass> traces, std::span<const WantedEvent> wanted) {
  Layout layout;
  for (std::size_t number = 0; number < traces.size(); ++number) {
    try {
      add_trace(layout, traces[number], wanted);
    } catch (const std::invalid_argument & error) {
      throw LayoutError(error.what(), number);
    }
  }
  if (!wanted.empty()) throw LayoutError("an event is wanted that is not declared", traces.size());
  return layout;
}

}  // namespace chainshaper::ctf
