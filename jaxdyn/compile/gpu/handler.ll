; What XLA calls for every kernel on a CUDA device. It stands behind handler.ll, whose functions it calls, in one module.
;
; In a table entry `kernel` is an array with the driver's handle of the function on each device, or null where the module is not loaded
; there; `chunk` is the number of threads in a block, and fewer than `least` samples are divided into blocks of one warp.
; `load` and `explain` are functions of Python's that return a message, the former null where there is no error.

@no.device = private constant [{DEVICE_BYTES} x i8] c"{DEVICE}\00"

define internal i64 @device(ptr %api, ptr %context, ptr %error.at) #0 {
  %args = alloca [4 x i64]
  store i64 28, ptr %args
  %extension = getelementptr [4 x i64], ptr %args, i32 0, i32 1
  store ptr null, ptr %extension
  %context.at = getelementptr [4 x i64], ptr %args, i32 0, i32 2
  store ptr %context, ptr %context.at
  %result.at = getelementptr [4 x i64], ptr %args, i32 0, i32 3
  store i64 0, ptr %result.at
  %ask.at = getelementptr i8, ptr %api, i64 184
  %ask = load ptr, ptr %ask.at
  %error = call ptr %ask(ptr %args)
  store ptr %error, ptr %error.at
  %result = load i32, ptr %result.at
  %wide = zext i32 %result to i64
  ret i64 %wide
}

define internal ptr @stream(ptr %api, ptr %context, ptr %error.at) #0 {
  %args = alloca [4 x i64]
  store i64 32, ptr %args
  %extension = getelementptr [4 x i64], ptr %args, i32 0, i32 1
  store ptr null, ptr %extension
  %context.at = getelementptr [4 x i64], ptr %args, i32 0, i32 2
  store ptr %context, ptr %context.at
  %result.at = getelementptr [4 x i64], ptr %args, i32 0, i32 3
  store ptr null, ptr %result.at
  %ask.at = getelementptr i8, ptr %api, i64 80
  %ask = load ptr, ptr %ask.at
  %error = call ptr %ask(ptr %args)
  store ptr %error, ptr %error.at
  %result = load ptr, ptr %result.at
  ret ptr %result
}

define ptr @cuda_handler(ptr %frame) #0 {
entry:
  %error.at = alloca ptr
  %n.at = alloca i64
  %extension.at = getelementptr %Frame, ptr %frame, i32 0, i32 1
  %extension = load ptr, ptr %extension.at
  %is.extended = icmp ne ptr %extension, null
  br i1 %is.extended, label %asked, label %execute
asked:
  %type.at = getelementptr %MetadataExtension, ptr %extension, i32 0, i32 1
  %type = load i32, ptr %type.at
  %is.metadata = icmp eq i32 %type, 1
  br i1 %is.metadata, label %metadata, label %execute
metadata:
  call void @describe(ptr %extension)
  ret ptr null
execute:
  %api.at = getelementptr %Frame, ptr %frame, i32 0, i32 2
  %api = load ptr, ptr %api.at
  %context.at = getelementptr %Frame, ptr %frame, i32 0, i32 3
  %context = load ptr, ptr %context.at
  %args = getelementptr %Frame, ptr %frame, i32 0, i32 5
  %results = getelementptr %Frame, ptr %frame, i32 0, i32 6
  %attributes.at = getelementptr %Frame, ptr %frame, i32 0, i32 7, i32 5
  %attributes = load ptr, ptr %attributes.at
  %scalar = load ptr, ptr %attributes
  %value.at = getelementptr { i32, ptr }, ptr %scalar, i32 0, i32 1
  %value = load ptr, ptr %value.at
  %hash = load i64, ptr %value
  %entry.at = call ptr @look_up(i64 %hash)
  %is.missing = icmp eq ptr %entry.at, null
  br i1 %is.missing, label %not.found, label %found
not.found:
  %error.missing = call ptr @failure(ptr %api, ptr @missing, i32 5)
  ret ptr %error.missing
found:
  %buffers.at = getelementptr %Entry, ptr %entry.at, i32 0, i32 4
  %buffers = load i64, ptr %buffers.at
  %sizes.at = getelementptr %Entry, ptr %entry.at, i32 0, i32 5
  %sizes = load ptr, ptr %sizes.at
  %args.count.at = getelementptr %List, ptr %args, i32 0, i32 2
  %args.count = load i64, ptr %args.count.at
  %results.count.at = getelementptr %List, ptr %results, i32 0, i32 2
  %results.count = load i64, ptr %results.count.at
  %count = add i64 %args.count, %results.count
  %is.counted = icmp eq i64 %count, %buffers
  br i1 %is.counted, label %measure, label %not.fitting
measure:
  %first.list = getelementptr %List, ptr %results, i32 0, i32 4
  %first.at = load ptr, ptr %first.list
  %first = load ptr, ptr %first.at
  %rank.at = getelementptr %Buffer, ptr %first, i32 0, i32 4
  %rank = load i64, ptr %rank.at
  %leading = sub i64 %rank, 1
  %n = call i64 @entries(ptr %first, i64 %leading)
  store i64 %n, ptr %n.at
  %data = alloca ptr, i64 %count
  %fits.args = call i1 @gather(ptr %args, ptr %data, ptr %sizes, i64 %n)
  %data.results = getelementptr ptr, ptr %data, i64 %args.count
  %sizes.results = getelementptr i64, ptr %sizes, i64 %args.count
  %fits.results = call i1 @gather(ptr %results, ptr %data.results, ptr %sizes.results, i64 %n)
  %fits = and i1 %fits.args, %fits.results
  br i1 %fits, label %fitting, label %not.fitting
not.fitting:
  %error.misfit = call ptr @failure(ptr %api, ptr @misfit, i32 3)
  ret ptr %error.misfit
fitting:
  ; The driver refuses a launch of no block.
  %is.empty = icmp eq i64 %n, 0
  br i1 %is.empty, label %done, label %where
where:
  %device = call i64 @device(ptr %api, ptr %context, ptr %error.at)
  %error.device = load ptr, ptr %error.at
  %is.device = icmp eq ptr %error.device, null
  br i1 %is.device, label %which, label %of.xla
which:
  %stream = call ptr @stream(ptr %api, ptr %context, ptr %error.at)
  %error.stream = load ptr, ptr %error.at
  %is.stream = icmp eq ptr %error.stream, null
  br i1 %is.stream, label %on.device, label %of.xla
of.xla:
  %error.xla = phi ptr [ %error.device, %where ], [ %error.stream, %which ]
  ret ptr %error.xla
on.device:
  %is.known = icmp ult i64 %device, {DEVICES}
  br i1 %is.known, label %look, label %not.known
not.known:
  %error.known = call ptr @failure(ptr %api, ptr @no.device, i32 12)
  ret ptr %error.known
look:
  %functions.at = getelementptr %Entry, ptr %entry.at, i32 0, i32 1
  %functions = load ptr, ptr %functions.at
  %function.at = getelementptr ptr, ptr %functions, i64 %device
  %ready = load atomic ptr, ptr %function.at acquire, align 8
  %is.ready = icmp ne ptr %ready, null
  br i1 %is.ready, label %launch, label %new
new:
  %load = inttoptr i64 {LOAD} to ptr
  %message = call ptr %load(i64 %hash, i64 %device, ptr %stream)
  %made = load atomic ptr, ptr %function.at acquire, align 8
  %is.made = icmp eq ptr %message, null
  br i1 %is.made, label %launch, label %failed
launch:
  %function = phi ptr [ %ready, %look ], [ %made, %new ]
  ; Parameters by their addresses: those of the buffers in `data`, then the number of samples.
  %more = add i64 %count, 1
  %parameters = alloca ptr, i64 %more
  br label %loop
loop:
  %i = phi i64 [ 0, %launch ], [ %i.next, %step ]
  %is.last = icmp eq i64 %i, %count
  br i1 %is.last, label %go, label %step
step:
  %from = getelementptr ptr, ptr %data, i64 %i
  %to = getelementptr ptr, ptr %parameters, i64 %i
  store ptr %from, ptr %to
  %i.next = add i64 %i, 1
  br label %loop
go:
  %end = getelementptr ptr, ptr %parameters, i64 %count
  store ptr %n.at, ptr %end
  %chunk.at = getelementptr %Entry, ptr %entry.at, i32 0, i32 2
  %chunk = load i64, ptr %chunk.at
  %least.at = getelementptr %Entry, ptr %entry.at, i32 0, i32 3
  %least = load i64, ptr %least.at
  %is.small = icmp slt i64 %n, %least
  %threads = select i1 %is.small, i64 32, i64 %chunk
  %padded = add i64 %n, %threads
  %less.one = sub i64 %padded, 1
  %blocks = sdiv i64 %less.one, %threads
  %x = trunc i64 %blocks to i32
  %width = trunc i64 %threads to i32
  %start = inttoptr i64 {LAUNCH} to ptr
  %code = call i32 %start(ptr %function, i32 %x, i32 1, i32 1, i32 %width, i32 1, i32 1, i32 0, ptr %stream, ptr %parameters, ptr null)
  %is.launched = icmp eq i32 %code, 0
  br i1 %is.launched, label %done, label %not.launched
not.launched:
  %explain = inttoptr i64 {EXPLAIN} to ptr
  %reason = call ptr %explain(i32 %code)
  br label %failed
failed:
  %why = phi ptr [ %message, %new ], [ %reason, %not.launched ]
  %error.driver = call ptr @failure(ptr %api, ptr %why, i32 13)
  ret ptr %error.driver
done:
  ret ptr null
}
